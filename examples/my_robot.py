"""A robot of your own: what its lidar sees, and how the shipped policy drives it: ``python -m examples.my_robot``."""

from __future__ import annotations

from pathlib import Path

from envs import NavigationEnv
from envs.metrics import episode_metrics
from envs.policy_env import OBSERVED, make_policy_env
from recipes.arguments import Parser
from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import rollout_preferences
from torchrl_morl.transforms import PreferenceSampler

ROBOT = Path(__file__).with_name("my_robot.yaml")
POLICY = Path(__file__).parents[1] / "recipes" / "policies" / "navigation"


def main(episodes: int = 20, seed: int = 7) -> None:
    """Print the scans of its 10 m lidar, and the metrics of a policy that is told which robot it drives."""
    env = NavigationEnv(robot=ROBOT, num_rays=720, max_range=10.0, num_envs=episodes, seed=seed)
    returns = (env.reset()["scan"] < env.max_range).float().sum(-1)
    print(f"{env.robot.name}: {returns.mean():.0f} of its 541 beams meet something at the start")

    policy = load_policy(POLICY)
    env = make_policy_env(
        PreferenceSampler(policy.preference_space),
        robot=ROBOT,
        num_envs=episodes,
        keep_simulation=True,
        **{name: getattr(policy.sensing, name) for name in OBSERVED},
    )
    preferences = policy.preference_space.corners()
    rollout = rollout_preferences(env, policy.actor, preferences, max_steps=300, seed=seed)
    for preference, metrics in zip(preferences, episode_metrics(rollout)):
        print(
            f"{policy.preference_space.tunable[preference.argmax()]:>10}: "
            f"{int(metrics['success'].sum())} of {episodes} at the goal, "
            f"{metrics['time'].nanmean():.1f} s, "
            f"{metrics['min_human_distance'].mean():.2f} m from the human"
        )


if __name__ == "__main__":
    Parser(description=__doc__).parse_args()  # --help; it takes nothing else
    main()
