"""Predictions of runs that are cut into pieces, each with its own start, and predictions of whole runs
condensed from those.

    joined      all starts s_i of pieces are unknowns; residuals (x(t_i+1; s_i, theta) - s_i+1) / width
    condensed   continuity is solved for, to first order:
                ds_i+1 = A_i ds_i + B_i dtheta + c_i,     c_i = x(t_i+1; s_i, theta) - s_i+1
                ds_i = L_i (dx_0, dtheta) + g_i           x_0: start of the run

Once pieces join (c = 0), residuals and derivatives equal those of the whole run. Source: H. G. Bock, in:
Modelling of Chemical Reaction Systems (1981) 102.
"""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jourdain_jax.identification.data.estimate import unbounded
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.solve.arrow import ByMember, ByUnknown, Flags, PerMember
from jourdain_jax.identification.solve.layout import Place
from jourdain_jax.identification.solve.levenberg_marquardt import Linearised
from jourdain_jax.identification.solve.problem import Asked, Problem, closed
from jourdain_jax.identification.solve.run_groups import Some
from jourdain_jax.identification.solve.shooting import (
    NODE,
    ends_of_pieces,
    in_pieces,
    numbers_of_filters,
    owned,
)
from jourdain_jax.identification.solve.unknowns import Places, Unknowns


@dataclass(frozen=True, eq=False)
class Shot:
    """Pieces of a fit by multiple shooting, and their continuity."""

    pieces: tuple[int, ...]  # number for each run
    # largest jump between neighbouring pieces, in tolerances of the simulation, atol + rtol |x|
    continuity: Float[np.ndarray, ""]
    sizes: Float[np.ndarray, "states"]  # of coordinates, speeds, and states of low-pass filters of sensors
    nodes: tuple[Float[np.ndarray, "nodes states"], ...]  # states (q, u, y) at the joints of each run


@dataclass
class _Standing(ByMember):
    """The current unknowns of the pieces of all members, with residuals and derivatives."""

    # unknowns of each piece, with its start state (node)
    local: Float[np.ndarray, "members pieces states_and_own"]
    theta: Float[np.ndarray, "members places"]  # unknowns of the whole runs
    # [J g r] of the whole runs by (member, run): Jacobian, residuals r, and their first-order change g when
    # pieces join
    rows: np.ndarray
    slopes: Float[np.ndarray, "members pieces states_and_own unknowns"]  # L
    gaps: Float[np.ndarray, "members pieces states_and_own"]  # g
    jumps: Float[np.ndarray, "members pieces states"]  # from the previous piece


class Piecewise(Problem):
    """The problem of whole runs, computed in pieces. `pieces`: the same problem, with the states at the
    joints as additional unknowns.
    """

    def __init__(self, asked: Asked, runs: tuple[Experiment, ...], unknowns: Unknowns):
        super().__init__(asked, runs, unknowns)
        scene, layout, shooting = asked.scene, unknowns.layout, asked.shooting
        assert shooting is not None
        of_runs = [
            len(scene.coordinate_names) + len(scene.speed_names) + numbers_of_filters(run) for run in runs
        ]
        self.states = max(of_runs)  # length of a node, zero-padded for runs with fewer low-pass filters
        self.ends_of = [ends_of_pieces(run, shooting, index) for index, run in enumerate(runs)]
        of_each = [in_pieces(run, ends, self.states) for run, ends in zip(runs, self.ends_of, strict=True)]
        parts = tuple(itertools.chain(*of_each))
        if len(parts) == len(runs):
            raise ValueError(
                "`shooting` leaves each run in one piece only; give a shorter `duration`, or omit `shooting`"
            )
        self.run_of = np.repeat(
            np.arange(len(runs)), [len(of_run) for of_run in of_each]
        )  # index of the run of each piece
        self.follows = np.concatenate([[False], np.diff(self.run_of) == 0])
        self.shared, self.own = layout.sizes
        # a piece starts at the end state of the previous piece, with the same sensor parameters
        self._carried = np.array(
            [k for place in layout.local if place.kind == "sensor" for k in range(place.begin, place.end)],
            int,
        )
        self._decided = np.concatenate([self._carried, self.own + np.arange(self.states)])
        self._states_of = np.array(of_runs)[self.run_of]
        self._layout = replace(layout, local=(*layout.local, Place(NODE, (self.states,), self.own, "start")))
        self.node_sizes = np.ones(self.states)
        self.pieces = Problem(asked, parts, self._unknowns(len(parts)))
        self._places = [self._places_of(i) for i in range(len(parts))]
        self.tolerance = float(asked.options.rtol), float(asked.options.atol)

    # With nodes as unknowns. --------------------------------------------------------------------------------

    def _unknowns(self, pieces: int) -> Unknowns:
        """Return the unknowns of all pieces with their nodes."""
        whole, free = self.unknowns, unbounded(1.0)
        of_nodes = np.array([unbounded(float(size)) for size in self.node_sizes], object)
        ranges = self._each(np.array(whole.ranges, object), free, free, of_nodes)
        means, weights = (
            self._each(x, 0.0, 0.0, 0.0, carried=False) for x in (whole.prior_mean, whole.prior_weight)
        )
        fixed, guess = self._each(whole.fixed, True, True, False), self.spread(whole.guess)
        return Unknowns(
            self._layout, pieces, guess, fixed, tuple(ranges), (), (), means, weights, whole.whitening
        )

    def measure(self, node_sizes: Float[np.ndarray, "states"]) -> None:
        """Set the sizes of the entries of nodes."""
        self.node_sizes = node_sizes
        self.pieces.unknowns = self._unknowns(len(self.follows))

    def spread(self, theta: Places) -> np.ndarray:
        """Return unknowns of whole runs as unknowns of all pieces, with nodes at zero."""
        return self._each(theta, 0.0, 0.0, 0.0)

    def _each(self, of_runs: np.ndarray, later, first_node, later_node, carried: bool = True) -> np.ndarray:
        """Return the unknowns of all pieces from the unknowns of whole runs. `later`: the start values of
        later pieces; `carried`: whether shared sensor parameters are copied to all pieces.
        """
        shared, own = self.unknowns.split(of_runs)
        own = own[..., self.run_of, :]
        own[..., self.follows[:, None] & ~(np.isin(np.arange(self.own), self._carried) & carried)] = later
        nodes = np.empty((*own.shape[:-1], self.states), own.dtype)
        nodes[...], nodes[..., self.follows, :] = first_node, later_node
        whole = np.concatenate([own, nodes], axis=-1)
        return np.concatenate([shared, whole.reshape(*whole.shape[:-2], -1)], axis=-1)

    def with_ends(
        self, theta: np.ndarray, members: np.ndarray
    ) -> tuple[list[Some], Float[np.ndarray, "members pieces states width"]]:
        """Return Jacobian and residuals [J r] of all pieces with these unknowns, and Jacobian and values [J
        x] of their end states.
        """
        _, pieces, M = self.pieces.unknowns.split(theta)[1].shape
        found, ends = [], np.zeros((len(members), pieces, self.states, M + self.shared + 1))
        for b, j, plain in self.pieces.evaluated(theta, members):
            rows, last = np.split(plain, [-self._states_of[j[0]]], axis=1)
            ends[b, j, : last.shape[1]] = last
            found.append((b, j, rows))
        return found, ends

    def _from_before(
        self, ends: np.ndarray, local: np.ndarray, piece: int
    ) -> Float[np.ndarray, "members decided width"]:
        """Return [A B c], a linear model of the gap between the end of the previous piece and the start of
        this one.
        """
        carried = np.zeros((len(local), self._carried.size, ends.shape[-1]))
        carried[:, range(self._carried.size), self._carried], carried[..., -1] = (
            1.0,
            local[:, piece - 1, self._carried],
        )
        rows = np.concatenate([carried, ends[:, piece - 1]], axis=1)
        rows[..., -1] -= local[:, piece, self._decided]
        return rows

    def with_gaps(self, theta: np.ndarray, members: np.ndarray, width: float) -> Linearised:
        """Return the objective with the starts of all pieces as unknowns. Gaps are residuals with the sigma
        `width`, in sizes of the states.
        """
        (some, ends), local = self.with_ends(theta, members), self.pieces.unknowns.split(theta)[1]
        at = self.pieces.assembled(theta, members, some, np.zeros((len(theta), len(self.with_memory))))
        count, pieces, M = local.shape
        joins = np.zeros((count, pieces, self._decided.size, 2 * M + self.shared + 1))
        sizes = width * np.concatenate([self.unknowns.least[self.shared + self._carried], self.node_sizes])
        with np.errstate(invalid="ignore"):
            for i in np.flatnonzero(self.follows).tolist():
                joins[:, i, :, M:] = self._from_before(ends, local, i)
                joins[:, i, range(self._decided.size), self._decided] = -1.0
            joins = joins / sizes[:, None]
        finite = np.isfinite(at.cost) & np.isfinite(joins.sum(axis=(1, 2, 3)))
        joins[~finite] = 0.0
        cost = np.where(finite, at.cost + 0.5 * np.sum(joins[..., -1] ** 2, axis=(1, 2)), np.inf)
        return replace(at, cost=cost, arrow=replace(at.arrow, joins=joins))

    # Condensed. ---------------------------------------------------------------------------------------------

    def put(self, theta: np.ndarray) -> ByUnknown:
        """Set the unknowns of the pieces of all members; return the unknowns of the whole runs."""
        shared, local = self.pieces.unknowns.split(theta)
        whole = np.concatenate([shared, local[:, ~self.follows, : self.own].reshape(len(theta), -1)], axis=1)
        slopes = np.zeros((*local.shape, self.own + self.shared))
        jumps = np.full((*local.shape[:2], self.states), np.inf)
        rows = np.empty((len(theta), len(self.runs)), object)
        self.at = _Standing(local.copy(), whole, rows, slopes, np.zeros(local.shape), jumps)
        return whole.copy()

    def put_nodes(self, theta: ByUnknown, found: Shot) -> None:
        """Set the pieces to the result of another fit of the same runs."""
        self.measure(found.sizes)
        whole = self.spread(theta)
        local = self.pieces.unknowns.split(whole)[1]  # a view
        local[:, self.follows, self.own :] = np.concatenate(found.nodes)
        self.put(whole)

    def told(self) -> Shot:
        """Return nodes, sizes and continuity of the pieces."""
        nodes = self.at.local[0, :, self.own :]
        return Shot(
            pieces=tuple(np.bincount(self.run_of).tolist()),
            continuity=np.asarray(self.continuity(np.array([0]))[0]),
            sizes=self.node_sizes,
            nodes=tuple(nodes[(self.run_of == run) & self.follows] for run in range(len(self.runs))),
        )

    def keep(self, member: int) -> None:
        """Keep only this member."""
        self.at = self.at.of([member])

    def evaluated(self, theta: ByUnknown, members: np.ndarray) -> Iterator[Some]:
        """Yield Jacobian and residuals [J r] of whole runs. The starts of pieces are moved with the unknowns,
        to first order, until the pieces join.
        """
        failed = np.zeros(len(members), bool)
        for _ in range(8):
            some = np.flatnonzero(
                ~failed & ~((theta == self.at.theta[members]).all(axis=1) & self.closed(members))
            )
            if not some.size:
                break
            failed[some] = ~self._move(theta[some], members[some], np.ones(some.size))
        for b, j, rows in self._of_runs(members, failed):
            yield b, j, closed(rows, self.own + self.shared)

    def moved(self, theta: ByUnknown, members: np.ndarray, share: PerMember) -> Iterator[Some]:
        """Return Jacobian and residuals [J g r] of whole runs after a fraction of each gap is closed. g is
        the change of r when all gaps are closed.
        """
        return self._of_runs(members, ~self._move(theta, members, share))

    def _of_runs(self, members: np.ndarray, failed: Flags) -> Iterator[Some]:
        here = np.arange(len(members))
        for run in range(len(self.runs)):
            rows = np.full((len(here), *self._shape(run)), np.nan)
            for b in here[~failed]:
                rows[b] = self.at.rows[members[b], run]
            yield here, np.full(len(here), run), rows

    def _shape(self, run: int) -> tuple[int, int]:
        """Return the shape of [J g r] of a run."""
        return max(where.stop for where in self.group_of[run].channels.values()), self.own + self.shared + 2

    def change(self, sigma: np.ndarray, d: np.ndarray, members: np.ndarray) -> PerMember:
        """Return |J d + g|, the change of all residuals, in units of sigma, due to a step d that also closes
        the gaps.
        """
        d_shared, d_own = self.unknowns.split(d)
        squares = np.zeros(len(d))
        for (b, member), run in itertools.product(enumerate(members.tolist()), range(len(self.runs))):
            rows = self.at.rows[member, run]
            moved = rows[:, :-2] @ np.concatenate([d_own[b, run], d_shared[b]]) + rows[:, -2]
            for name, where in self.group_of[run].channels.items():
                by = sigma[b, self.estimated.index(name)] if name in self.estimated else 1.0
                squares[b] += np.sum((moved[where] / by) ** 2)
        return np.sqrt(squares)

    def _by_piece(self, theta: ByUnknown) -> Float[np.ndarray, "members pieces own_and_shared"]:
        """Return the unknowns of each piece's run, followed by the shared ones."""
        shared, own = self.unknowns.split(theta)
        each = np.broadcast_to(shared[:, None], (len(theta), len(self.run_of), self.shared))
        return np.concatenate([own[:, self.run_of], each], axis=2)

    def growth(self, members: np.ndarray) -> PerMember:
        """Return the largest factor by which small changes of the unknowns grow beyond the first node, in
        sizes of states and unknowns.
        """
        sizes = self._by_piece(self.unknowns.sizes(self.at.theta[members]))
        slopes = self.at.slopes[members][:, :, self.own :] * sizes[:, :, None] / self.node_sizes[:, None]
        lengths = np.sqrt(np.sum(slopes**2, axis=(2, 3)))[:, self.follows]
        return np.maximum(
            np.max(lengths, axis=1) / np.maximum(np.min(lengths, axis=1), np.finfo(float).tiny), 1.0
        )

    @contextmanager
    def unmoved(self) -> Iterator[None]:
        """Return a context in which the objective can be evaluated at other unknowns. On exit the pieces are
        restored.
        """
        kept = self.at.of(np.arange(len(self.at.theta)))
        yield
        self.at = kept

    def closed(self, members: np.ndarray) -> Flags:
        """Return whether the pieces join, to the tolerance of the simulation."""
        return self.continuity(members) <= 1.0

    def continuity(self, members: np.ndarray) -> PerMember:
        """Return the largest jump between neighbouring pieces, in tolerances of the options, `atol + rtol
        |x|`.
        """
        rtol, atol = self.tolerance
        allowed = atol + rtol * np.maximum(np.abs(self.at.local[members][..., self.own :]), self.node_sizes)
        return np.max(np.abs(self.at.jumps[members]) / allowed, axis=(1, 2), initial=0.0)

    def _move(self, theta: ByUnknown, members: np.ndarray, share: PerMember) -> Flags:
        """Move the pieces of some members to other unknowns. Return which members do not fail there; failing
        members are not moved.
        """
        m, M = self.own, self.own + self.states
        before, (shared, own) = self.at.of(members), self.unknowns.split(theta)
        local = (
            before.local
            + (before.slopes @ self._by_piece(theta - before.theta)[..., None])[..., 0]
            + share[:, None, None] * before.gaps
        )
        local[:, ~self.follows, :m] = own
        some, ends = self.with_ends(np.concatenate([shared, local.reshape(len(theta), -1)], axis=1), members)
        rows = np.empty(local.shape[:2], object)
        for (b, j), one in itertools.chain(
            *(zip(zip(b, j, strict=True), plain, strict=True) for b, j, plain in some)
        ):
            rows[b, j] = one
        whole, jumps = np.empty((len(theta), len(self.runs)), object), np.zeros(ends.shape[:-1])
        new = _Standing(local, theta, whole, 0 * before.slopes, 0 * before.gaps, jumps)
        with np.errstate(over="ignore", invalid="ignore"):
            for i in range(len(self.follows)):
                if not self.follows[i]:
                    new.slopes[:, i, range(m), range(m)] = 1.0
                    continue
                # ds_i = A ds_i-1 + B dtheta + c
                joint = self._from_before(ends, local, i)
                new.slopes[:, i, self._decided] = joint[..., :M] @ new.slopes[:, i - 1]
                new.slopes[:, i, self._decided, m:] += joint[..., M:-1]
                new.gaps[:, i, self._decided] = (joint[..., :M] @ new.gaps[:, i - 1, :, None])[
                    ..., 0
                ] + joint[..., -1]
                new.jumps[:, i] = joint[:, self._carried.size :, -1]
            good = np.isfinite(new.slopes.sum(axis=(1, 2, 3)) + new.gaps.sum(axis=(1, 2)))
        for b in np.flatnonzero(good):
            for run in range(len(self.runs)):
                new.rows[b, run] = self._condensed(run, rows[b], new.slopes[b], new.gaps[b])
            good[b] = all(np.isfinite(x.sum()) for x in new.rows[b])
        self.at.put(members[good], new.of(good))
        return good

    def _condensed(
        self, run: int, rows_of: np.ndarray, slopes: np.ndarray, gaps: np.ndarray
    ) -> Float[np.ndarray, "samples width"]:
        """Return [J g r] of a whole run from Jacobians and residuals [J r], derivatives L and gaps of all
        pieces.
        """
        M, found = self.own + self.states, np.zeros(self._shape(run))
        for i in np.flatnonzero(self.run_of == run):
            of_piece, of_run = self._places[i]
            rows = rows_of[i][of_piece]
            J = rows[:, :M] @ slopes[i]
            J[:, self.own :] += rows[:, M:-1]
            found[of_run] = np.concatenate([J, (rows[:, :M] @ gaps[i])[:, None], rows[:, -1:]], axis=1)
        return found

    def _places_of(self, piece: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of a piece that belong to its run, and their indices in the run."""
        run = int(self.run_of[piece])
        before = piece - int(np.flatnonzero(self.run_of == run)[0])
        first, firsts = self.ends_of[run][before], owned(self.runs[run], self.ends_of[run])
        of_piece, of_run = [], []
        for name, where in self.pieces.group_of[piece].channels.items():
            width = int(np.prod(self.runs[run].values[name].shape[1:]))
            begin, end = firsts[name][before : before + 2]
            samples = np.arange(width * begin, width * end)
            of_piece.append(where.start + samples - width * first)
            of_run.append(self.group_of[run].channels[name].start + samples)
        return np.concatenate(of_piece), np.concatenate(of_run)
