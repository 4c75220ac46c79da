"""What a closed loop does: margins, stability, noise, responses."""
