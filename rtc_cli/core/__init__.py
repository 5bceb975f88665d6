"""Pure JAX: chunk geometry, flow matching, delays, guidance, conditioning, networks, policies.

No files, no clocks, no physics. Flow time `tau` is 0 for noise and 1 for data, everywhere.
"""
