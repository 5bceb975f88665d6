"""Running chunked policies in worlds: timeline, methods, rollouts and metrics.

Nothing is imported here: ``timeline``, ``methods`` and ``metrics`` need neither JAX nor pymunk.
"""
