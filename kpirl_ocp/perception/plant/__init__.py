"""The simulated robot behind its camera and detector, for a controller to act on."""
