"""Real-time execution of action-chunking flow policies: train, evaluate, profile, report."""

__version__ = "0.1.0"
