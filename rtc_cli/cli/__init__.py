"""The command line: one file per command; `app` holds the error boundary."""
