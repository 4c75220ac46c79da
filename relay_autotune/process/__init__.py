"""Processes: transfer functions and structures, their exact responses and simulation."""
