"""The command line: one file per command; `app` holds the error boundary.

A command's module is named like the command and has a `typer.Typer` called `app`. Its top level
imports nothing heavy (no JAX, pymunk, pandas, matplotlib), so that help and completion are quick;
the work is imported inside the command's function.
"""
