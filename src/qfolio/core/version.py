"""The version of qfolio."""

__version__ = "0.1.0"
