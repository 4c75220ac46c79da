"""The parts of a relay experiment: settling, the first kick, oscillation, levels, its end."""
