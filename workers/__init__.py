"""Jobs: shells of a few lines over run_* functions, which take their stores and clock as arguments."""
