"""Training with rsl-rl's PPO, and the checkpoints it leaves."""
