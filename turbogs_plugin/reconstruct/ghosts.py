"""Ghosts: cameras that a solve puts in a wrong place, at a low reprojection error, because structure repeats.

Repeated structure (a papered wall, a row of windows) gives pairs of photos many matches that are consistent within the
pair and wrong. A solver that registers a few photos by such pairs builds a second, shifted copy of what they show. Its
own error stays low, since it then drops the true matches as outliers. But these are still there: between two photos
that see the same place there are more of them than the repeated part alone gives. So each verified pair is asked
whether its matches agree with the cameras as they were solved. Where a group of photos has more matches with the rest
that contradict the solve than matches that agree, the other explanation is the better one.

Grouping is correlation clustering by greedy edge contraction (GAEC; Keuper et al., Efficient decomposition of image and
mesh graphs by lifted multicuts, ICCV 2015). The idea of contradicting evidence is from Zach et al., Disambiguating
visual relations using loop constraints, CVPR 2010.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

STRONGEST = 10
"""Pairs of each photo with the most matches, which count fully: they see the same place. Other pairs, of which a large
capture has many times as many, may share no more than a pattern."""
WEAK = 1e-3
"""Weight of all other pairs: they decide where there is no other evidence."""
POWER = 1.5
"""Exponent of the number of matches in a pair's weight: above 1, since pairs that see the same place have more."""


@dataclass(frozen=True)
class Agreement:
    """How the matches of P pairs of V photos agree with the cameras of a solve."""

    names: tuple[str, ...]  # of the photos
    pairs: np.ndarray  # [P, 2] int64, places among the names
    agreeing: np.ndarray  # [P] int64, verified matches on the epipolar lines of the cameras
    contradicting: np.ndarray  # [P] int64, verified matches off these lines

    @property
    def contradicts(self) -> np.ndarray:
        """[P] bool: pairs most of whose matches contradict the cameras."""
        return self.contradicting > self.agreeing


def consistent_groups(agreement: Agreement) -> list[list[int]]:
    """Photos, by ascending places, in groups that the matches hold together, the largest first; between two groups the
    contradicting matches outweigh the agreeing ones. All photos in one group: no majority contradicts the solve."""
    weights = agreement.agreeing**POWER - agreement.contradicting**POWER
    weights[~_strongest(agreement)] *= WEAK
    return _contracted(len(agreement.names), agreement.pairs, weights)


def ghost_pairs(agreement: Agreement, groups: list[list[int]]) -> np.ndarray:
    """[P] bool: pairs that agree with the solve, between groups that more matches say are elsewhere: by these the solve
    put the groups in their places."""
    group = np.zeros(len(agreement.names), dtype=np.int64)
    for number, members in enumerate(groups):
        group[members] = number
    first, second = agreement.pairs.reshape(-1, 2).T
    return (group[first] != group[second]) & ~agreement.contradicts


def _strongest(agreement: Agreement) -> np.ndarray:
    """[P] bool: pairs that are among the `STRONGEST` of either photo."""
    strongest = np.zeros(len(agreement.pairs), dtype=bool)
    count = np.zeros(len(agreement.names), dtype=np.int64)
    order = np.argsort(-(agreement.agreeing + agreement.contradicting), kind="stable")
    for pair, (first, second) in zip(order.tolist(), agreement.pairs[order].tolist(), strict=True):
        strongest[pair] = count[first] < STRONGEST or count[second] < STRONGEST
        count[first] += 1
        count[second] += 1
    return strongest


def _contracted(count: int, pairs: np.ndarray, weights: np.ndarray) -> list[list[int]]:
    """Nodes merged along the heaviest edge, whose weights then add up, until no edge has a positive weight."""
    links: list[dict[int, float]] = [defaultdict(float) for _ in range(count)]
    for (first, second), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
        links[first][second] += weight
        links[second][first] += weight
    heap = [(-weight, node, other) for node in range(count) for other, weight in links[node].items() if node < other]
    heapq.heapify(heap)
    members = [[node] for node in range(count)]
    while heap:
        weight, node, other = heapq.heappop(heap)
        if weight >= 0:
            break
        if links[node].get(other) != -weight:  # merged or changed since: a newer entry is in the heap
            continue
        if len(links[node]) < len(links[other]):
            node, other = other, node
        members[node] += members[other]
        members[other] = []
        del links[node][other], links[other][node]
        for third, added in links[other].items():
            del links[third][other]
            total = links[node][third] + added
            links[node][third] = links[third][node] = total
            heapq.heappush(heap, (-total, min(node, third), max(node, third)))
        links[other] = {}
    return sorted((sorted(group) for group in members if group), key=lambda group: (-len(group), group))
