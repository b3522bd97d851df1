"""``python -m torchrl_morl_ros``: the node, as ``ros2 run torchrl_morl_ros policy_node``."""

from .node import main

if __name__ == "__main__":
    main()
