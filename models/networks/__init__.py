"""Small blocks that networks of any family are made of."""
