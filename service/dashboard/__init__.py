"""The dashboard: one page whose script polls the JSON API of the same origin."""
