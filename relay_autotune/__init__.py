"""Relay-feedback autotuning: experiments, identification and controller design."""

__version__ = "0.1.0"
