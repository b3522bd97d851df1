"""Drive the shipped policy through a scene of your own: ``python -m examples.doorway``."""

from __future__ import annotations

from pathlib import Path

from envs.metrics import episode_metrics
from envs.policy_env import OBSERVED, make_policy_env
from recipes.arguments import Parser
from torchrl_morl.deploy import load_policy
from torchrl_morl.evaluation import rollout_preferences
from torchrl_morl.transforms import PreferenceSampler

SCENE = Path(__file__).with_name("doorway.yaml")
POLICY = Path(__file__).parents[1] / "recipes" / "policies" / "navigation"


def main(episodes: int = 20, seed: int = 7) -> None:
    """Print how the policy does under each preference for one objective alone."""
    policy = load_policy(POLICY)
    env = make_policy_env(
        PreferenceSampler(policy.preference_space),
        scene=SCENE,
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
