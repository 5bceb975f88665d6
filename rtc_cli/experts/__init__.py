"""Expert policies: trained by PPO on the task itself, they act in the demonstrations."""
