"""Samples to correlator outputs, NCO control and symbols. Signs and records: ``tracking.records``."""
