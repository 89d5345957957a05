"""Evaluation: the methods side by side, their figures and their pictures."""
