"""Speed of the recurrent world model's training."""
