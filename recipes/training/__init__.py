"""What the trainings share: task, agent, replay, gradients, optimizers, the off-policy loop, logs, run folder."""
