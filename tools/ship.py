"""Ships the policy of a run for its task, with its card.

It measures the policy with the float16 weights that it ships.

`python tools/ship.py RUN --mode deterministic --command "mqe train go1gate --seed 3" --date
2026-11-27 --note "The best of five seeds, after 40.0 M steps. It trained on one H100."`

In a match, the card holds the rates on both sides against the scripted, an idle and a random team,
and how episodes against the scripted team end.
"""

import argparse
from tempfile import TemporaryDirectory
from typing import Any

from mqe_jax import evaluate
from mqe_jax.core.settings import build
from mqe_jax.envs import TASKS
from mqe_jax.envs.match import Match
from mqe_jax.policies import load_policy, zoo
from mqe_jax.train.policy import save_policy

DIGITS = 4


def measure(run: str, task: str, episodes: int, deterministic: bool) -> dict[str, Any]:
    """Returns the entries `results` and `endings` of a policy's card."""
    results = {}
    endings = {}
    match = issubclass(TASKS[task], Match)
    sides = "both" if match else None
    for opponent in ("random", "idle", "scripted") if match else (None,):
        options: dict[str, Any] = {"episodes": episodes, "deterministic": deterministic}
        options |= {"impl": "c", "sides": sides or "first"}
        found = evaluate(run, opponent=opponent, **options).to_dict()
        rates = {}
        if match:
            rates[f"win/{opponent}"] = found["win_rate"]
        else:
            rates["success"] = found["success_rate"]
        if opponent == "scripted":
            rates["loss/scripted"] = found["loss_rate"]
        for name, rate in rates.items():
            value = round(rate, DIGITS)
            results[name] = {"value": value, "episodes": episodes, "sides": sides}
        causes = [name for name in found if name.startswith("ending/")]
        endings = {name.removeprefix("ending/"): round(found[name], DIGITS) for name in causes}
    return {"results": results, "endings": endings}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run")
    parser.add_argument("--mode", choices=("deterministic", "sampled"), required=True)
    for option in ("--command", "--date", "--note"):
        parser.add_argument(option, required=True)
    parser.add_argument("--gpu-minutes", type=float)
    parser.add_argument("--episodes", type=int, default=512)
    given = vars(parser.parse_args())
    policy = load_policy(given.pop("run"))
    with TemporaryDirectory() as folder:
        rounded = str(save_policy(folder, policy, half=True))
        means = given["mode"] == "deterministic"
        given |= measure(rounded, policy.task, given.pop("episodes"), means)
    print(zoo.ship(policy, build(zoo.Card, given)))
