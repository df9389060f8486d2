"""Correlator outputs and inertial data to position, velocity and time. Records: ``nav.records``."""
