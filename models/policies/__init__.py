"""Policies p(actions | observations), by which behavior is made that covers good and bad."""
