"""The model card of a policy: what it reads and commands, how it did, how it is used."""

from __future__ import annotations

from typing import Any

from .policy import Policy

__all__ = ["model_card"]

_TAGS = (
    "reinforcement-learning",
    "multi-objective-reinforcement-learning",
    "robotics",
    "navigation",
    "torchrl",
    "mujoco",
)
_UNITS = {
    "success": "%",
    "collision": "%",
    "timeout": "%",
    "time": "s",
    "human": "m",
    "frechet": "m",
    "frechet all": "m",
}
"""Of the columns that the recipes put into a card."""


def model_card(
    policy: Policy, repo_id: str, *, film: str | None = None, license: str | None = None
) -> str:
    """A model card in Markdown, with the metadata that the Hub reads.

    Args:
        policy: that it describes.
        repo_id: where it is uploaded to.

    Keyword Args:
        film: name of the film in the repository.
        license: such as ``"mit"``; none is named if ``None``.

    Example:
        >>> from torchrl_morl.testing import untrained_policy
        >>> card = model_card(untrained_policy(), "me/mine", license="mit")
        >>> print(card[: card.index("tags")])
        ---
        library_name: torchrl-morl
        pipeline_tag: robotics
        license: mit
        >>> "| a command every | 0.2 s |" in card
        True
    """
    parts = [_front_matter(license), f"# {repo_id.rpartition('/')[2]}", _what_it_is(policy)]
    if film is not None:
        shown = film.endswith(".gif")
        parts.append(
            "![The policy drives](film.gif)" if shown else f'<video controls src="{film}"></video>'
        )
    parts += [_usage(repo_id), _contract(policy)]
    if (table := _evaluation(policy.card.get("evaluation"))) is not None:
        parts.append(table)
    parts.append(
        "It was trained in simulation. **It is no safety function**: a bumper or a safety lidar that works "
        "without it stays necessary."
    )
    return "\n\n".join(parts) + "\n"


def _front_matter(license: str | None) -> str:
    entries = ["library_name: torchrl-morl", "pipeline_tag: robotics"]
    if license is not None:
        entries.append(f"license: {license}")
    return "\n".join(["---", *entries, "tags:", *(f"- {tag}" for tag in _TAGS), "---"])


def _what_it_is(policy: Policy) -> str:
    names = ", ".join(map(_one_cell, policy.preference_space.tunable))
    return (
        "A navigation policy of torchrl-morl that follows a preference while it drives: weights of "
        f"{names}, not negative, 1 together. Weights are safetensors, everything else is JSON; neither "
        "can run code when it is opened."
    )


def _usage(repo_id: str) -> str:
    return "\n".join(
        [
            "```python",
            "from torchrl_morl.deploy import from_hub, load_policy",
            "",
            f'policy = load_policy(from_hub("{repo_id}"))',
            "```",
        ]
    )


def _contract(policy: Policy) -> str:
    rows = [("robot", policy.robot), ("a command every", f"{policy.period:g} s")]
    for name, unit in (("speed", "m/s"), ("turn_rate", "rad/s")):
        low, high = getattr(policy.limits, name)
        rows.append((name.replace("_", " "), f"{low:.4g} to {high:.4g} {unit}"))
    sensing = policy.sensing
    if sensing is not None:
        rows.append(("lidar", f"{sensing.num_sectors} sectors, up to {sensing.max_range:g} m"))
        rows.append(("goal", "distance (m), bearing (rad)"))
        velocity = ", velocity (m/s)" if sensing.observe_human_velocity else ""
        nobody = ", or nobody" if sensing.observe_nobody else ""
        seen = f"distance (m), bearing (rad){velocity}{nobody}"
        rows.append(("human", seen if sensing.observe_human else "not read"))
        if sensing.observe_robot:
            rows.append(
                (
                    "which robot it drives",
                    "radius (m), top speed (m/s), top turn rate (rad/s), view (rad), range (m) and place "
                    "(m) of the lidar; commands are within its limits",
                )
            )
        if sensing.observe_motion:
            rows.append(
                ("how the robot moves", "odometry; the runner remembers the last four commands")
            )
    return _table(("it reads and commands", ""), rows)


def _evaluation(results: Any) -> str | None:
    """A table of what the training found at its end; ``None`` if the card has none of that form."""
    if not isinstance(results, dict) or not isinstance(results.get("preferences"), list):
        return None
    names = results["preferences"]
    columns = {
        name: values
        for name, values in results.items()
        if isinstance(values, list)
        and len(values) == len(names)
        and all(isinstance(value, (int, float)) for value in values)
    }
    if not columns:
        return None
    heads = [f"{name}, {_UNITS[name]}" if name in _UNITS else name for name in columns]
    rows = [
        (str(name), *(f"{column[index]:.4g}" for column in columns.values()))
        for index, name in enumerate(names)
    ]
    return "## Evaluation at the end of the training\n\n" + _table(("preference", *heads), rows)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_one_cell, line)) + " |" for line in lines)


def _one_cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
