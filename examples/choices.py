"""A preference from choices, of any policy with a vector return: MO-Gymnasium's dam, flooding against need.

Six policies release more or less water; a table holds their returns in a few seasons. Somebody who says
which of two seasons is better, a few times, gets the policy that fits. Nothing here knows a robot.
"""

import mo_gymnasium
import numpy as np
import torch

from torchrl_morl import PreferenceSpace
from torchrl_morl.choices import PreferencePosterior, best_preference, next_question, standardize

SPACE = PreferenceSpace(("flooding", "deficit"))
SEASONS = 20


def returns() -> torch.Tensor:
    """Vector returns of a policy under six preferences, each in the same seasons, ``[S, P, 2]``."""
    env = mo_gymnasium.make("water-reservoir-v0")
    table = []
    for season in range(SEASONS):
        rows = []
        for flooding, _ in SPACE.lattice(5).tolist():
            state, _ = env.reset(seed=season)
            total = np.zeros(2)
            for _ in range(50):
                # Against flooding: release what is stored. Against deficit: what is needed.
                release = flooding * float(state[0]) + (1 - flooding) * 50.0
                state, reward, *_ = env.step(np.array([release], dtype=np.float32))
                total += np.asarray(reward)[:2]
            rows.append(total)
        table.append(np.stack(rows))
    env.close()
    return torch.tensor(np.stack(table), dtype=torch.float32)


def main(weight_of_flooding: float = 0.7, answers: int = 5) -> torch.Tensor:
    """Ask somebody who weighs flooding so; the preference that is found."""
    outcomes = standardize(returns())
    weights = torch.tensor([weight_of_flooding, 1 - weight_of_flooding])
    posterior = PreferencePosterior(SPACE.tunable)
    for number in range(answers):
        generator = torch.Generator().manual_seed(number)
        question = next_question(posterior, outcomes, generator=generator)
        pair = outcomes[question.scene, [question.first, question.second]]
        answer = "first" if pair[0] @ weights > pair[1] @ weights else "second"
        posterior.answer(*pair, answer)
        best = best_preference(posterior, outcomes, SPACE.lattice(5))
        print(f"after answer {number + 1}, {answer}: {best}")
    print(posterior)
    return best.preference


if __name__ == "__main__":
    main()
