"""HTTP handlers: parse, one rule, answer."""
