"""Tables, sessions, queries and blobs: every SELECT of the product lives here."""
