"""Records of experiments: samples, cycles, relays in recordings of others, excitation."""
