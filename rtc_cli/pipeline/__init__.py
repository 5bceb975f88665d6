"""What a run computes: stages, the plan that orders them, the executor that runs it."""
