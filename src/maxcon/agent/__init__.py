"""The learned Q-function: network, inference without torch, training, shipped weights."""
