"""Losses for multi-objective reinforcement learning."""

from torchrl_morl.objectives.angle import AngleForm, angle_between
from torchrl_morl.objectives.bradley_terry import BradleyTerryLoss
from torchrl_morl.objectives.gae import MultiObjectiveGAE
from torchrl_morl.objectives.mo_td3 import MOTD3Loss

__all__ = ["AngleForm", "BradleyTerryLoss", "MOTD3Loss", "MultiObjectiveGAE", "angle_between"]
