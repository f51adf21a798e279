"""Subgoal generators p(x[t+1:t+K] | x_t), one file a family. No action is anywhere in their path."""
