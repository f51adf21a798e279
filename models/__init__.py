"""The science: world models, inverse dynamics, subgoal generators and what is computed with them. Imports torch."""
