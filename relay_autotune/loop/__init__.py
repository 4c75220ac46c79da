"""Closed loops: gains, the law as it runs, margins, stability, noise, responses."""
