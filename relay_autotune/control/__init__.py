"""Controllers that run on a loop, and the proof of their gains."""
