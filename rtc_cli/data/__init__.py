"""Demonstrations: episodes of experts on disk, and the action chunks cut from them."""
