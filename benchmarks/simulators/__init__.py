"""How fast the robot simulators are, how exactly they replay, and what an episode looks like."""
