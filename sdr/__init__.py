"""Composition: scenario, receiver loop, storage, campaigns, figures and the command line."""
