"""The built-in tasks: one module each, its docstring is the task's description."""
