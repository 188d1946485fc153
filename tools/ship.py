"""Ships the policy of a run for its task: measures it with the float16 weights that it ships, writes it with its card.

`python tools/ship.py RUN --mode deterministic --command "mqe train go1gate --seed 3" --date 2026-11-27 --note NOTE`

In a match, the card holds the rates against the scripted, an idle and a random team, and how episodes against the
scripted team end.
"""

import argparse
from tempfile import TemporaryDirectory

from mqe_jax.cli.commands import Eval
from mqe_jax.envs import TASKS
from mqe_jax.envs.match import Match
from mqe_jax.policies import load_policy, mixture, zoo

DIGITS = 4


def measure(run: str, task: str, episodes: int, deterministic: bool) -> tuple[dict[str, float], dict[str, float]]:
    """Returns the entries `results` and `endings` of a policy's card."""
    results, endings = {}, {}
    match = issubclass(TASKS[task], Match)
    for opponent in ("random", "idle", "scripted") if match else (None,):
        options = {"episodes": episodes, "deterministic": deterministic, "impl": "c", "json": True}
        shown = Eval(target=run, opponent=opponent, **options).run()
        found = {name: round(value, DIGITS) for name, value in shown.items() if isinstance(value, float)}
        if match:
            results |= {f"{name}/{opponent}": found[f"{name}_rate"] for name in ("win", "loss")}
        else:
            results["success"] = found["success_rate"]
        endings = {name.removeprefix("ending/"): x for name, x in found.items() if name.startswith("ending/")}
    return {name: x for name, x in results.items() if name not in ("loss/random", "loss/idle")}, endings


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--mode", choices=("deterministic", "sampled"), required=True)
    for option in ("--command", "--date", "--note"):
        parser.add_argument(option, required=True)
    parser.add_argument("--gpu-minutes", type=float)
    parser.add_argument("--episodes", type=int, default=512)
    given = vars(parser.parse_args())
    policy = load_policy(given.pop("run"))
    with TemporaryDirectory() as folder:
        rounded = str(mixture.save(folder, policy, half=True))
        results, endings = measure(rounded, policy.task, given["episodes"], given["mode"] == "deterministic")
    print(zoo.ship(policy, zoo.Card(results=results, endings=endings, **given)))
