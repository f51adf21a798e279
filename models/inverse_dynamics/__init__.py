"""Inverse dynamics h(z_t, z_{t+1}) -> a_t, one file a family."""
