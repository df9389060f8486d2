"""Statistics on correlator outputs and innovations, thresholds, and detection probabilities."""
