"""What a recorded limit cycle shows: its average and scatter, shape, harmonics, steady state."""
