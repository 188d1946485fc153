"""Mixtures: policies that draw one of a few trained policies at the start of each episode."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import MaxLen, MinLen

from mqe_jax.core import devices
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Fraction, PositiveInt
from mqe_jax.core.precision import single
from mqe_jax.core.settings import PathText, check, check_arguments, fail
from mqe_jax.core.types import Memory, RandomKey
from mqe_jax.train.checkpoint import read_metadata
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.needs import Needs
from mqe_jax.train.policy import (
    POLICY_FILE,
    TrainedPolicy,
    file_content,
    policy_in,
    policy_path,
    save_policy,
    write_policy,
)

MEMBERS = 4
"""Members of a mixture, at most."""


@dataclasses.dataclass(frozen=True)
class Mixture:
    """A policy that draws one of its members for each episode.

    Its recurrent state holds the number of the member, 0 until the first `act` of an episode draws
    it, and the states of all members, which act in every step. Without a random key the member with
    the largest weight acts.
    """

    members: tuple[TrainedPolicy, ...]
    """Policies with equal needs; each samples its actions or acts with the means, as its file
    says."""
    weights: tuple[float, ...]
    """Probability of each member; the sum is 1."""
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Further entries of the file, such as the card of a shipped mixture."""

    def __post_init__(self) -> None:
        members = check(
            "members", self.members, Annotated[tuple[Any, ...], MinLen(1), MaxLen(MEMBERS)]
        )
        if not all(isinstance(member, TrainedPolicy) for member in members):
            fail("members", members, "trained policies")
        weights = check("weights", self.weights, tuple[Fraction, ...])
        if len(weights) != len(members) or abs(math.fsum(weights) - 1.0) > 1e-6:
            fail("weights", self.weights, f"{len(members)} numbers whose sum is 1")
        for name, value in {"members": members, "weights": weights}.items():
            object.__setattr__(self, name, value)
        check("metadata", self.metadata, Mapping[str, Any])
        for i, member in enumerate(self.members):
            for name, (own, other) in self.needs.mismatches(member.needs).items():
                fail("members", f"{name} {other!r} of member {i}", f"that of member 0, {own!r}")

    def __repr__(self) -> str:
        shares = ", ".join(f"{100 * weight:.0f}%" for weight in self.weights)
        return f"<Mixture of {self.task}: {len(self.members)} members, {shares}>"

    @property
    def needs(self) -> Needs:
        """What the members need of their environment."""
        return self.members[0].needs

    @property
    def heaviest(self) -> TrainedPolicy:
        """The member with the largest weight, the first of several."""
        return self.members[int(np.argmax(self.weights))]

    @property
    def config(self) -> TrainConfig:
        """Settings with which the heaviest member was trained."""
        return self.heaviest.config

    @property
    def deterministic(self) -> bool:
        """Whether all members act with their mean actions."""
        return all(member.deterministic for member in self.members)

    def acting(self, deterministic: bool) -> Self:
        """Returns the mixture whose members act with their mean actions, or sample them."""
        return dataclasses.replace(
            self, members=tuple(member.acting(deterministic) for member in self.members)
        )

    def at_size(self, env: Any) -> Self:
        """Returns the mixture whose members act in an environment; see `TrainedPolicy`."""
        return dataclasses.replace(
            self, members=tuple(member.at_size(env) for member in self.members)
        )

    @property
    def task(self) -> str:
        """Id of the task."""
        return self.needs.task

    @property
    def agents(self) -> int:
        """Number of agents of the team."""
        return self.needs.dims.agents

    @property
    def groups(self) -> tuple[str, ...]:
        """The group of observations that the members see."""
        return (self.needs.group,)

    @check_arguments(num_envs=PositiveInt | None)
    def initial_memory(self, num_envs: int | None = None) -> Memory:
        """Returns the recurrent state at an episode's start; see `TrainedPolicy`."""
        member = jnp.zeros(() if num_envs is None else num_envs)
        return {
            "member": member,
            "members": tuple(each.initial_memory(num_envs) for each in self.members),
        }

    @single
    def act(
        self, obs: Any, memory: Memory, key: jax.Array | None = None
    ) -> tuple[jax.Array, Memory]:
        """Returns the actions of the drawn members; see `TrainedPolicy`."""
        check("key", key, RandomKey | None)
        if jax.tree.structure(memory) != jax.tree.structure(self.initial_memory()):
            fail("memory", memory, "the recurrent state of this mixture, that of `initial_memory`")
        draw_key, key = (None, None) if key is None else jax.random.split(key)
        member = jnp.where(
            memory["member"] < 0.5,
            self._draw(jnp.shape(memory["member"]), draw_key),
            memory["member"],
        )
        acts = [
            each.act(obs, own, key)
            for each, own in zip(self.members, memory["members"], strict=True)
        ]
        action = acts[-1][0]
        for number in range(len(acts) - 1, 0, -1):
            action = jnp.where(member[..., None, None] < number + 0.5, acts[number - 1][0], action)
        return action, {"member": member, "members": tuple(own for _, own in acts)}

    def _draw(self, shape: tuple[int, ...], key: jax.Array | None) -> jax.Array:
        """Returns the numbers of members, from 1, drawn for environments by normal numbers, which
        graphs have too.
        """
        if key is None:
            return jnp.full(shape, 1.0 + int(np.argmax(self.weights)))
        last = max(i for i, weight in enumerate(self.weights) if weight > 0)
        shares = [min(math.fsum(self.weights[: i + 1]), 1 - 1e-12) for i in range(last)]
        ends = [NormalDist().inv_cdf(share) if share else -math.inf for share in shares]
        normal = devices.normal(key, (math.prod(shape),), jnp.float32).reshape(shape)
        return sum(((normal > end).astype(jnp.float32) for end in ends), jnp.ones(shape))


Trained = TrainedPolicy | Mixture
"""Policies that files hold."""


@check_arguments(folder=PathText, mixture=Mixture, name=PathText, half=bool)
def save_mixture(
    folder: str | Path, mixture: Mixture, name: str = POLICY_FILE, *, half: bool = False
) -> Path:
    """Writes a mixture as one file, its members as `save_policy` does; errors as there."""
    arrays, records = zip(*(file_content(member, half) for member in mixture.members), strict=True)
    metadata = {**mixture.metadata, "members": records, "weights": mixture.weights}
    return write_policy(folder, name, {"members": arrays}, metadata)


def save(
    folder: str | Path, policy: Trained, name: str = POLICY_FILE, *, half: bool = False
) -> Path:
    """Writes a policy or a mixture into a folder; see `save_policy` and `save_mixture`."""
    if isinstance(policy, Mixture):
        return save_mixture(folder, policy, name, half=half)
    return save_policy(folder, policy, name, half=half)


@single
def read(run: str | Path) -> Trained:
    """Reads the policy or the mixture of a run folder or a policy file; errors as `read_policy`."""
    path = policy_path(run)
    metadata = read_metadata(path, kind="policy")
    if "members" not in metadata:
        return policy_in(path, metadata)
    try:
        records = check(
            "members", metadata.pop("members"), Annotated[list[dict[str, Any]], MaxLen(MEMBERS)]
        )
        weights = metadata.pop("weights")
        members = (policy_in(path, record, f"members/{i}/") for i, record in enumerate(records))
        return Mixture(tuple(members), weights, metadata)
    except (KeyError, InputError) as error:
        text = str(error)
        raise InputError(
            text if str(path) in text else f"{path}: its members cannot be read ({text})"
        ) from None
