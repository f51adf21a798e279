"""Simulators and the scripted behaviors that act in them, behind one protocol (`base`) and one list (`catalog`)."""
