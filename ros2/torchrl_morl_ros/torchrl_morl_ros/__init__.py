"""A ROS 2 node that drives a robot with a policy of torchrl_morl.

Everything but ``node``, ``publishing`` and ``transforms`` runs without ROS: messages are read by
their fields.
"""
