"""World models f(z_t, a_t) -> z_{t+1}, one file a family."""
