"""What an agent is made of and how it is trained: every choice in one place, written into its model card.

`paper()` is the agent strictly as the paper writes it. Every field marked "departure n" is explained, with what it
bought, under that number in docs/deviations.md, and can be switched off on its own.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from maxcon.tree.encoding import CHANNELS, PAPER_CHANNELS

#: Settings that agent files may lack, being older.
_LATER = {"estimate"}


@dataclass(frozen=True)
class NetworkConfig:
    """The Q-network (section 3.4).

    Attributes
    ----------
    widths
        Output width of each EdgeConv layer; the layers' outputs are concatenated.
    neighbours
        How many nearest neighbours in H, the point itself included, each point looks at.
    global_width
        Width of the global feature.
    head
        Hidden widths of the MLP on [point feature, global feature].
    channels
        Which channels the state has besides H; departure 1 adds "ratio", "level" and "multiplier".
    canonical
        Departure 2: H in a form that does not depend on the units of the data.
    estimate
        Departure 12: H has a further column, the residual of theta = 0 relative to the threshold. Only for problems
        posed so that theta = 0 is an estimate.
    """

    widths: tuple[int, ...] = (32, 32, 64)
    neighbours: int = 10
    global_width: int = 64
    head: tuple[int, ...] = (64, 32)
    channels: tuple[str, ...] = CHANNELS
    canonical: bool = True
    estimate: bool = False


@dataclass(frozen=True)
class TrainConfig:
    """Algorithm 1 and its settings.

    Attributes
    ----------
    n_points, n_params
        Size of the training instances (N, d).
    low_rate, high_rate
        The outlier rate of each instance is uniform in this range (section 3.5).
    n_instances
        How many instances the training set holds.
    updates
        How many gradient steps are made.
    batch, memory
        Batch size, and how many transitions the replay memory holds.
    discount
        The discount factor gamma (the paper gives none; 1 counts removals).
    learning_rate, final_learning_rate
        Adam's step size, from first to last (cosine).
    exploration, final_exploration
        epsilon of the epsilon-greedy policy, falling linearly over the first half of the training.
    reward_scale
        Departure 7: the reward of a step is minus this, not -1, which keeps errors where Huber's loss is quadratic.
    clip
        Largest norm of a gradient, 0 for none.
    n_episodes
        Departure 3: how many episodes run side by side; an update is made after each has made a step.
    target_every
        Departure 4: the target network is copied every so many updates; 0 for no target network.
    n_step
        Departure 5: the target looks so many steps ahead.
    double
        Departure 6: the online network chooses, the target network values (double Q-learning).
    seed
        Seeds everything.
    """

    n_points: int = 100
    n_params: int = 2
    low_rate: float = 0.01
    high_rate: float = 0.40
    n_instances: int = 4000
    updates: int = 20000
    batch: int = 64
    memory: int = 60000
    discount: float = 1.0
    learning_rate: float = 1e-3
    final_learning_rate: float = 2e-5
    exploration: float = 0.5
    final_exploration: float = 0.03
    reward_scale: float = 0.1
    clip: float = 5.0
    n_episodes: int = 16
    target_every: int = 100
    n_step: int = 5
    double: bool = True
    seed: int = 0


@dataclass(frozen=True)
class DataConfig:
    """Where the training instances come from; `maxcon.experiments.training` draws them.

    Attributes
    ----------
    source
        "hyperplane": the paper's lines and planes. Of fundamental matrices: "scene" (made scenes), "modelnet" (meshes
        of ModelNet40) or "kitti" (random matches of image pairs of a drive).
    threshold
        The inlier threshold that an episode goes down to.
    chart
        The chart of the fundamental matrix (`maxcon.vision.fundamental_problem`).
    sequence, frames, steps
        Of "kitti": which drive, the first and the last frame used, and how far apart the frames of a pair are.
    started_from
        The SHA-256 digest of the agent file that training started from; empty where it started from nothing.
    """

    source: str = "hyperplane"
    threshold: float = 0.1
    chart: str = "auto"
    sequence: str = ""
    frames: tuple[int, ...] = (0, 24)
    steps: tuple[int, ...] = (1, 3)
    started_from: str = ""


@dataclass(frozen=True)
class AgentConfig:
    """Network, training and the data of the training together."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    data: DataConfig = field(default_factory=DataConfig)

    def to_dict(self) -> dict[str, Any]:
        """Return nested plain dictionaries, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> AgentConfig:
        """Return the configuration that `to_dict` made `values` of; ValueError if a setting is missing or unknown.

        What came later than the first agent files may be missing, and then has its default: all of "data", and
        "estimate".
        """

        def build(kind: type[Any], entries: dict[str, Any]) -> Any:
            known = {each.name for each in fields(kind)}
            if not known - _LATER <= set(entries) <= known:
                raise ValueError(f"values must have the settings {sorted(known)}, but they have {sorted(entries)}")
            return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in entries.items()})

        data = build(DataConfig, values["data"]) if "data" in values else DataConfig()
        return cls(build(NetworkConfig, values["network"]), build(TrainConfig, values["train"]), data)

    def override(self, **changes: Any) -> AgentConfig:
        """Return a copy with the named fields, of the network, the training or its data, changed.

        Raises
        ------
        TypeError
            If no field has the name.
        """
        parts = {name: {each.name for each in fields(getattr(self, name))} for name in ("network", "train", "data")}
        known = set().union(*parts.values())
        if unknown := set(changes) - known:
            raise TypeError(f"unknown setting {sorted(unknown)[0]!r}; settings are {sorted(known)}")
        return AgentConfig(
            *(
                replace(getattr(self, part), **{name: value for name, value in changes.items() if name in names})
                for part, names in parts.items()
            )
        )


def shipped(n_params: int, seed: int = 0) -> AgentConfig:
    """Return the configuration of the agents that the package ships."""
    return AgentConfig().override(n_params=n_params, seed=seed)


def paper(n_params: int, seed: int = 0) -> AgentConfig:
    """Return the agent strictly as the paper writes it: every numbered departure switched off."""
    return AgentConfig().override(
        n_params=n_params,
        seed=seed,
        channels=PAPER_CHANNELS,
        canonical=False,
        n_episodes=1,
        target_every=0,
        n_step=1,
        double=False,
    )


def fundamental(base: AgentConfig, source: str = "scene") -> AgentConfig:
    """Return `base` for fundamental matrices, d = 8: the paper's outlier rates of section 4.2, 10 to 50%.

    An agent that departs from the paper at all is told of the chart's estimate, too (departure 12).

    Parameters
    ----------
    base
        `shipped` or `paper` of 8 parameters.
    source
        "scene", "modelnet" or "kitti"; the threshold is the paper's for each, 0.1 or, for "kitti", 0.01.
    """
    threshold = 0.01 if source == "kitti" else 0.1
    return base.override(
        source=source, threshold=threshold, low_rate=0.1, high_rate=0.5, estimate=base.network.canonical
    )


def fine_tuning(base: AgentConfig, seed: int = 0) -> AgentConfig:
    """Return the configuration that goes on with a trained agent of configuration `base` on other data.

    Smaller steps and less exploration than from nothing, so that what was learned is not thrown away first.
    """
    return base.override(
        seed=seed, learning_rate=2e-4, final_learning_rate=1e-5, exploration=0.1, final_exploration=0.02, updates=5000
    )
