"""What crosses the wire: requests, answers, job payloads and error bodies. Imports nothing but pydantic."""
