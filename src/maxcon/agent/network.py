"""The Q-network of section 3.4 in torch: EdgeConv features, global feature, concatenation, MLP, basis mask."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from maxcon.agent.config import NetworkConfig
from maxcon.agent.graph import batched_neighbour_max, scatter_gradient

#: Slope of the leaky ReLU below 0.
LEAK = 0.2


class _NeighbourMax(torch.autograd.Function):
    """Maximum over the neighbours, compiled: gathering (B, N, k, C) first takes five times as long."""

    @staticmethod
    def forward(ctx: Any, q: Tensor, graph: Tensor) -> Tensor:
        values = q.detach().contiguous().numpy()
        out = np.empty_like(values)
        which = np.empty(values.shape, dtype=np.int32)
        batched_neighbour_max(values, graph.numpy(), out, which)
        ctx.which = which
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        gradient = gradients[0].contiguous().numpy()
        out = np.zeros_like(gradient)
        scatter_gradient(gradient, ctx.which, out)
        return torch.from_numpy(out), None


class EdgeConv(nn.Module):
    """One EdgeConv layer with one linear layer: ``p_i + max_j q_j``, LayerNorm, leaky ReLU (Wang et al. 2019)."""

    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__()
        self.own = nn.Linear(n_in, n_out)
        self.other = nn.Linear(n_in, n_out, bias=False)
        self.norm = nn.LayerNorm(n_out)

    def forward(self, x: Tensor, graph: Tensor) -> Tensor:
        """Map x, shape (B, N, n_in), to (B, N, n_out)."""
        largest: Tensor = _NeighbourMax.apply(self.other(x), graph)  # type: ignore[no-untyped-call]
        return functional.leaky_relu(self.norm(self.own(x) + largest), LEAK)


class QNetwork(nn.Module):
    """Q-values of the removal of each basis point.

    Parameters
    ----------
    n_features
        Columns of H.
    config
        Widths and channels.
    """

    def __init__(self, n_features: int, config: NetworkConfig) -> None:
        super().__init__()
        widths = (n_features + len(config.channels), *config.widths)
        self.edge = nn.ModuleList(EdgeConv(a, b) for a, b in pairwise(widths))
        total = sum(config.widths)
        self.pool = nn.Linear(2 * total, config.global_width)
        sizes = (total + config.global_width, *config.head, 1)
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))

    def forward(self, H: Tensor, graph: Tensor, channels: Tensor, basis: Tensor) -> Tensor:
        """Return the Q-value of every slot, shape (B, n), minus infinity where a slot is empty.

        Parameters
        ----------
        H
            Shape (B, N, n_features).
        graph
            Shape (B, N, k), int32: the neighbours of each point.
        channels
            Shape (B, N, n_channels): what changes with the state.
        basis
            Shape (B, n), int64: the basis points, -1 in empty slots.
        """
        x = torch.cat([H, channels], dim=2)
        layers = []
        for edge in self.edge:
            x = edge(x, graph)
            layers.append(x)
        features = torch.cat(layers, dim=2)
        pooled = torch.cat([features.amax(dim=1), features.mean(dim=1)], dim=1)
        everything = functional.leaky_relu(self.pool(pooled), LEAK)
        # The basis mask comes first: an MLP on each point by itself need not see the points that it masks.
        slots = basis.clamp(min=0).unsqueeze(2).expand(-1, -1, features.shape[2])
        value = torch.cat([features.gather(1, slots), everything.unsqueeze(1).expand(-1, basis.shape[1], -1)], dim=2)
        for layer in self.head[:-1]:
            value = functional.leaky_relu(layer(value), LEAK)
        q: Tensor = self.head[-1](value).squeeze(2)
        return q.masked_fill(basis < 0, -torch.inf)
