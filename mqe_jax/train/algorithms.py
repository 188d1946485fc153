"""The registry of algorithms: which `Stages` an update of the learner has.

An algorithm is one registered settings class whose `build` returns its stages. To add one, derive
other stages from `mqe_jax.train.stages.Stages` and register their settings:

    @register_stages("mine")
    class Mine(StagesSettings):
        trust: Positive = 0.2

        def build(self, network: Network, config: TrainConfig) -> Stages: ...

The settings import no JAX, so that a wrong flag of `mqe train` is named at once.
"""

from collections.abc import Callable, Mapping
from typing import Any, NoReturn, dataclass_transform

from mqe_jax.core.errors import nearest
from mqe_jax.core.lazy import load
from mqe_jax.core.settings import FrozenMapping, build, check, checked, fail, name_settings
from mqe_jax.train.networks import Network


class StagesSettings:
    """Base of every algorithm's settings class.

    Example:
        ```python
        from mqe_jax.core.settings import Positive
        from mqe_jax.train.algorithms import StagesSettings, register_stages
        from mqe_jax.train.stages import Stages

        class Bounding(Stages):
            def advantages(self, now, transitions, value, next_value):
                advantage, target = super().advantages(now, transitions, value, next_value)
                bound = self.config.stages.bound
                return advantage.clip(-bound, bound), target

        @register_stages("bounding")
        class Bounds(StagesSettings):
            bound: Positive = 3.0

            def build(self, network, config):
                return Bounding(network, config)

        mqe_jax.learn("go1gate", {"config": "demo", "stages": {"name": "bounding", "bound": 2.0}})
        ```
    """

    name: str
    """Registered name of the algorithm that the other fields configure."""

    def build(self, network: Network, config: Any) -> Any:
        """Returns the `Stages` of a training with the settings `config`, a `TrainConfig`.

        InputError if the settings do not fit them.
        """
        raise NotImplementedError


STAGES: dict[str, type[StagesSettings]] = {}
"""Settings classes by the name that `stages.name` gives."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
@checked
def register_stages(name: str) -> Callable[[type[Any]], type[Any]]:
    """Makes a class the settings class of an algorithm and registers it."""

    def register(cls: type[Any]) -> type[Any]:
        if not (isinstance(cls, type) and issubclass(cls, StagesSettings)):
            fail("stages", cls, "a class derived from StagesSettings")
        STAGES[name] = name_settings(cls, name)
        return STAGES[name]

    return register


class UnknownStages(FrozenMapping, StagesSettings):
    """Settings of an algorithm that nobody registered: its policies can act, but not train."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.name = values["name"]

    def build(self, network: Network, config: Any) -> Any:
        """Raises the InputError of `refuse`."""
        self.refuse()

    def refuse(self) -> NoReturn:
        """Raises an InputError that names the registered algorithms."""
        hint = nearest(self.name, STAGES)
        fail("stages.name", self.name, f"a registered algorithm: {', '.join(STAGES)}{hint}")


def stages_settings(value: Any) -> Any:
    """Returns the settings that a mapping with a `name` describes (by default ppo)."""
    if not isinstance(value, Mapping):
        return value
    name = check("name", value.get("name", "ppo"), str)
    return build(STAGES[name], value) if name in STAGES else UnknownStages(value)


@register_stages("ppo")
class PPOStages(StagesSettings):
    """The package's algorithms, which the settings `ppo` tell apart."""

    def build(self, network: Network, config: Any) -> Any:
        return load("mqe_jax.train.stages:Stages")(network, config)
