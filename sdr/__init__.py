"""Composition: scenario, receiver loop, storage, campaigns, figures and the command line."""

SCHEMA_VERSION = 1
"""Version of the result files and of the JSON objects."""


def version() -> str:
    """Version of the installed distribution."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    try:
        return installed("gnss-baseband")
    except PackageNotFoundError:
        return "0+unknown"
