"""Algorithm 1 of the paper: deep Q-learning on the tree, with a replay memory."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from maxcon.agent.config import AgentConfig
from maxcon.agent.graph import neighbour_graph, point_features
from maxcon.agent.network import QNetwork
from maxcon.agent.replay import ReplayMemory, StateBatch, encode
from maxcon.problem import LinearProblem
from maxcon.tree.batch import BatchEnvironment, Instances, make_instances
from maxcon.tree.encoding import channel_flags

#: How often in a row an instance that needs no removal may be drawn: then there is hardly another.
_MOST_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Instances with the part of the network's input that never changes: H and its neighbour graph."""

    instances: Instances
    H: Tensor
    graph: Tensor


def prepare(problems: list[LinearProblem], threshold: float, config: AgentConfig) -> TrainingSet:
    """Return `problems`, all of one size, as the network and the environment need them."""
    H = [point_features(problem, threshold, config.network) for problem in problems]
    graph = [neighbour_graph(each, config.network.neighbours) for each in H]
    return TrainingSet(
        make_instances(problems, threshold), torch.from_numpy(np.stack(H)), torch.from_numpy(np.stack(graph))
    )


class Learner:
    """Everything that changes during training; `iterate` is one pass through the body of Algorithm 1."""

    def __init__(self, data: TrainingSet, config: AgentConfig) -> None:
        self.data, self.config = data, config
        train = config.train
        torch.manual_seed(train.seed)
        self.rng = np.random.default_rng(train.seed)
        self.flags = channel_flags(config.network.channels)
        self.network = QNetwork(data.H.shape[2], config.network)
        self.target = copy.deepcopy(self.network) if train.target_every else self.network
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=train.learning_rate)
        self.environment = BatchEnvironment(data.instances, train.n_episodes)
        self.memory = ReplayMemory(train.memory, self.environment)
        self.updates = 0

    def q_values(self, network: QNetwork, states: StateBatch | BatchEnvironment) -> Tensor:
        """Return Q of every slot, shape (B, n)."""
        channels = torch.from_numpy(encode(self.data.instances, states, self.flags))
        where = torch.from_numpy(states.instance)
        result: Tensor = network(self.data.H[where], self.data.graph[where], channels, torch.from_numpy(states.basis))
        return result

    def act(self) -> None:
        """Make an epsilon-greedy step in every episode; a finished one goes on with another instance (lines 3-9)."""
        environment, train = self.environment, self.config.train
        for _ in range(_MOST_DRAWS):
            if not environment.done.any():
                break
            finished = np.flatnonzero(environment.done)
            environment.reset(finished, self.rng.integers(0, len(self.data.instances), len(finished)))
        else:
            raise ValueError(f"problems must need a removal, but {_MOST_DRAWS} draws in a row found one that does not")
        with torch.no_grad():
            actions = self.q_values(self.network, environment).argmax(dim=1).numpy()
        through = min(1.0, 2.0 * self.updates / train.updates)
        exploration = train.exploration + through * (train.final_exploration - train.exploration)
        size = (environment.basis >= 0).sum(axis=1)
        random_slot = (self.rng.random(len(size)) * size).astype(np.int64)
        actions = np.where(self.rng.random(len(size)) < exploration, random_slot, actions)
        self.memory.store(environment)
        environment.step(actions)
        self.memory.close(actions, environment.done)

    def targets(self, later: StateBatch, steps: NDArray[np.int64], finished: NDArray[np.bool_]) -> Tensor:
        """Return the right-hand side of equation 12: rewards up to `later`, then its best Q-value."""
        train = self.config.train
        with torch.no_grad():
            q = self.q_values(self.target, later)
            if train.double:  # departure 6
                choice = self.q_values(self.network, later).argmax(dim=1, keepdim=True)
                best = q.gather(1, choice).squeeze(1)
            else:
                best = q.amax(dim=1)
        powers = train.discount ** np.arange(train.n_step + 1)
        rewards = -train.reward_scale * np.concatenate([[0.0], np.cumsum(powers[:-1])])[steps]
        ahead = torch.from_numpy(np.where(finished, 0.0, powers[steps]).astype(np.float32))
        return torch.from_numpy(rewards.astype(np.float32)) + ahead * torch.where(ahead > 0, best, 0.0)

    def update(self) -> float:
        """Draw a batch from the memory and move the parameters down the temporal-difference error (lines 10-11)."""
        train = self.config.train
        drawn = self.memory.sample(self.rng, train.batch, train.n_step)
        target = self.targets(drawn.later, drawn.steps, drawn.finished)
        q = self.q_values(self.network, drawn.state)
        loss = functional.huber_loss(q.gather(1, torch.from_numpy(drawn.action)[:, None]).squeeze(1), target)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if train.clip:
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), train.clip)
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.updates / train.updates)))
        for group in self.optimizer.param_groups:
            group["lr"] = train.final_learning_rate + cosine * (train.learning_rate - train.final_learning_rate)
        self.optimizer.step()
        self.updates += 1
        if train.target_every and self.updates % train.target_every == 0:  # departure 4
            self.target.load_state_dict(self.network.state_dict())
        return float(loss.detach())

    def iterate(self) -> float:
        """Act, and update once the memory holds enough; return the loss (NaN before the first update)."""
        self.act()
        train = self.config.train
        if self.memory.count * train.n_episodes < train.batch * 4 or self.memory.count <= 2 * train.n_step:
            return math.nan
        return self.update()
