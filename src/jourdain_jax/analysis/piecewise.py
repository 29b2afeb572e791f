"""The predictions of runs that are cut into pieces, each with a start of its own; and those of the whole runs, condensed from them.

    joined      all starts s_i of pieces are unknowns, continuity is a residual of some width: (x(t_i+1; s_i, theta) - s_i+1) / width
    condensed   continuity is solved for, to first order:   ds_i+1 = A_i ds_i + B_i dtheta + c_i,     c_i = x(t_i+1; s_i, theta) - s_i+1
                ds_i = L_i (dx_0, dtheta) + g_i             leaves the unknowns of a fit without pieces, x_0: those of the start of the run

Once pieces join (c = 0), residuals and derivatives are those of the whole run. Source: H. G. Bock, in: Modelling of Chemical Reaction Systems (1981) 102.
"""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.analysis.estimate import Range, unbounded
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.layout import Place
from jourdain_jax.analysis.levenberg_marquardt import Linearised
from jourdain_jax.analysis.losses import Loss
from jourdain_jax.analysis.problem import Problem, closed
from jourdain_jax.analysis.runs import Lanes, Some
from jourdain_jax.analysis.shooting import NODE, MultipleShooting, ends_of_pieces, in_pieces, numbers_of_filters, owned
from jourdain_jax.analysis.unknowns import Unknowns
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.scene.scene import Scene

_CLOSINGS = 8  # times at most that pieces are joined anew, to first order, at numbers that stay
_FREE = unbounded(1.0)


@dataclass(frozen=True, eq=False)
class Shot:
    """How a fit was found by multiple shooting."""

    pieces: tuple[int, ...]  # of each run
    continuity: Float[np.ndarray, ""]  # the largest jump from one piece to the next, in tolerances of the options, atol + rtol |x|
    sizes: Float[np.ndarray, "states"]  # of coordinates, speeds, and what low-passes of sensors give
    nodes: tuple[Float[np.ndarray, "nodes states"], ...]  # states (q, u, y) at which the pieces of each run meet


@dataclass
class _Standing:
    """Where the pieces of all members are, and what was found there; all with an axis of members in front."""

    local: Float[np.ndarray, "members pieces states_and_own"]  # unknowns of each piece, with its node
    theta: Float[np.ndarray, "members places"]  # those of the whole runs
    rows: np.ndarray  # (members, runs) of [J g r] of the whole runs: r will have changed by g, to first order, once pieces join
    slopes: Float[np.ndarray, "members pieces states_and_own unknowns"]  # L
    gaps: Float[np.ndarray, "members pieces states_and_own"]  # g
    jumps: Float[np.ndarray, "members pieces states"]  # from the piece before

    @staticmethod
    def of(local: np.ndarray, theta: np.ndarray, runs: int, unknowns: int, states: int) -> "_Standing":
        """Before anything was found. `unknowns`: of a run and shared; `states`: of a node."""
        members, pieces, width = local.shape
        jumps = np.full((members, pieces, states), np.inf)
        return _Standing(local, theta, np.empty((members, runs), object), np.zeros((members, pieces, width, unknowns)), np.zeros(local.shape), jumps)

    def only(self, members) -> "_Standing":
        """A copy of that of some members."""
        return _Standing(*(part[list(members)] for part in vars(self).values()))


class Piecewise:
    """Whole runs that are worked out in pieces, `evaluate`, and the problem with nodes as unknowns."""

    def __init__(self, scene: Scene, runs: tuple[Experiment, ...], unknowns: Unknowns, options: AllOptions, shooting: MultipleShooting):
        self.scene, self.runs, self.unknowns, layout = scene, runs, unknowns, unknowns.layout
        of_runs = [len(scene.coordinate_names) + len(scene.speed_names) + numbers_of_filters(run) for run in runs]
        self.states = max(of_runs)  # of a node; zero where a run has fewer low-passes than another
        self.ends_of = [ends_of_pieces(run, shooting, index) for index, run in enumerate(runs)]
        parts = [in_pieces(run, ends, self.states) for run, ends in zip(runs, self.ends_of, strict=True)]
        self.parts = tuple(piece for of_run in parts for piece in of_run)
        if all(len(of_run) == 1 for of_run in parts):
            raise ValueError("`shooting` leaves each run in one piece only; give a shorter `duration`, or leave out `shooting`")
        self.run_of = np.repeat(np.arange(len(runs)), [len(of_run) for of_run in parts])  # of each piece
        self.follows = np.concatenate([[False], np.diff(self.run_of) == 0])
        p, m = layout.sizes
        self.own, self.shared = m, p
        self.layout = replace(layout, local=(*layout.local, Place(NODE, (self.states,), m)))
        self._carried = np.array([k for place in layout.local if place.of_sensor for k in range(place.begin, place.end)], int)  # the same in all pieces
        self.lanes, self.whole = Lanes(scene, self.parts, self.layout, options, None), Lanes(scene, runs, layout, options, None)
        self._states_of = np.array(of_runs)[self.run_of]
        self.rows = np.empty((0, len(self.parts)), object)  # (members, pieces) of [J r], where they were evaluated last
        self.ends = np.zeros((0, len(self.parts), self.states, 0))  # [J x] of the states at the ends
        samples = [max(where.stop for where in self.whole.group_of(run).channels.values()) for run in range(len(runs))]
        self._shapes = [(count, m + p + 2) for count in samples]  # of [J g r] of each run
        self._places = [self._places_of(i) for i in range(len(self.parts))]
        self.node_sizes = np.ones(self.states)
        self.tolerance = float(options.rtol), float(options.atol)
        self.at = _Standing.of(np.zeros((0, len(self.parts), m + self.states)), np.zeros((0, p + len(runs) * m)), len(runs), m + p, self.states)
        self.closing, self.share = True, np.ones(0)  # whether pieces are joined at each evaluation; else what share of their gaps goes, by member

    # With nodes as unknowns. ----------------------------------------------------------------------------------------

    def problem(self, loss: Loss) -> Problem:
        """The problem of pieces whose starts have nothing to do with each other."""
        return Problem(self.scene, self.parts, self._unknowns_of_pieces(), self.lanes, loss, self.evaluate_parts)

    def evaluate_parts(self, shared, local, members) -> Iterator[Some]:
        """As `evaluate` of `Lanes`, of all pieces; what they end at is kept aside."""
        self.rows = np.empty((len(members), len(self.parts)), object)
        self.ends = np.full((len(members), len(self.parts), self.states, local.shape[-1] + shared.shape[-1] + 1), np.nan)
        for b, j, plain in self.lanes.evaluate(shared, local, members):
            rows, ends = np.split(plain, [-self._states_of[j[0]]], axis=1)
            self.ends[b, j] = 0.0
            self.ends[b, j, : ends.shape[1]] = ends
            for place, one in zip(zip(b.tolist(), j.tolist(), strict=True), rows, strict=True):
                self.rows[place] = one
            yield b, j, rows

    def _unknowns_of_pieces(self) -> Unknowns:
        whole, m, p, count = self.unknowns, self.own, self.shared, len(self.parts)

        def each(of_run: Sequence, of_node, of_later) -> list:
            found = list(of_run[:p])
            for i, run in enumerate(self.run_of.tolist()):
                own = list(of_run[p + run * m : p + (run + 1) * m])
                if self.follows[i]:
                    own = [x if k in self._carried else of_later for k, x in enumerate(own)]
                found += [*own, *([of_node] * self.states if self.follows[i] else [of_later] * self.states)]
            return found

        ranges: list[Range] = each(whole.ranges, None, _FREE)
        scales = [unbounded(float(size)) for size in self.node_sizes]
        ranges = [scales[(k - p - m) % (m + self.states)] if found is None else found for k, found in enumerate(ranges)]
        no_prior = np.full((count, m + self.states), np.nan)
        prior = []
        for of_run in (whole.prior_mean, whole.prior_sigma):
            own = no_prior.copy()
            own[~self.follows, :m] = of_run[p:].reshape(len(self.runs), m)  # not once more for each piece
            prior.append(np.concatenate([of_run[:p], own.ravel()]))
        fixed = np.array(each(whole.fixed.tolist(), False, True), bool)
        return Unknowns(self.layout, count, self.spread(whole.guess[None])[0], fixed, tuple(ranges), (), (), prior[0], prior[1], whole.whitening)

    def spread(self, theta: Float[np.ndarray, "members places"]) -> Float[np.ndarray, "members all_places"]:
        """Unknowns of whole runs as those of all pieces, with nodes at zero."""
        shared, own = self.unknowns.split(theta)
        of_pieces = np.zeros((len(theta), len(self.parts), self.own + self.states))
        of_pieces[..., : self.own] = own[:, self.run_of]
        later = np.setdiff1d(np.arange(self.own), self._carried)
        of_pieces[:, self.follows[:, None] & np.isin(np.arange(self.own + self.states), later)] = 0.0
        return np.concatenate([shared, of_pieces.reshape(len(theta), -1)], axis=1)

    def joined(self, problem: Problem, theta: np.ndarray, members: np.ndarray, width: float) -> Linearised:
        """What is minimised with the starts of all pieces as unknowns: their gaps are residuals of this width, in sizes of the states."""
        at = problem.linearised(theta, members)
        m, carried = self.own, self._carried
        local = problem.unknowns.split(theta)[1]
        count, pieces, M = local.shape
        joins = np.zeros((count, pieces, self.states + carried.size, 2 * M + self.shared + 1))
        with np.errstate(invalid="ignore"):
            for i in np.flatnonzero(self.follows):
                end, join = self.ends[:, i - 1], joins[:, i]
                join[:, : self.states, M:-1] = end[..., :-1]
                join[:, : self.states, -1] = end[..., -1] - local[:, i, m:]
                join[:, range(self.states), range(m, M)] = -1.0
                rows = range(self.states, joins.shape[2])
                join[:, rows, carried], join[:, rows, M + carried], join[:, rows, -1] = -1.0, 1.0, local[:, i - 1, carried] - local[:, i, carried]
            sizes = np.concatenate([self.node_sizes, self.unknowns.least[self.shared :][carried]]) if carried.size else self.node_sizes
            joins = joins / (width * sizes)[:, None]
        joins[~np.isfinite(at.cost)] = 0.0
        finite = np.isfinite(joins.sum(axis=(1, 2, 3)))
        joins[~finite] = 0.0
        cost = np.where(finite, at.cost + 0.5 * np.sum(joins[..., -1] ** 2, axis=(1, 2)), np.inf)
        return replace(at, cost=cost, arrow=replace(at.arrow, joins=joins))

    # Condensed. -----------------------------------------------------------------------------------------------------

    def put(self, theta: Float[np.ndarray, "members all_places"]) -> Float[np.ndarray, "members places"]:
        """Puts the pieces of all members where they are here; the unknowns of the whole runs."""
        shared, local = theta[:, : self.shared], theta[:, self.shared :].reshape(len(theta), len(self.parts), -1)
        own = local[:, ~self.follows, : self.own].reshape(len(theta), -1)
        whole = np.concatenate([shared, own], axis=1)
        self.at = _Standing.of(local.copy(), whole, len(self.runs), self.own + self.shared, self.states)
        self.share = np.ones(len(theta))
        return self.at.theta.copy()

    def put_nodes(self, theta: Float[np.ndarray, "members places"], found: Shot) -> None:
        """Puts the pieces where another fit of the same runs ended."""
        self.node_sizes = found.sizes
        whole = self.spread(theta)
        local = whole[:, self.shared :].reshape(len(theta), len(self.parts), -1)  # a view
        local[:, self.follows, self.own :] = np.concatenate(found.nodes)
        self.put(whole)

    def told(self) -> Shot:
        """How the pieces join where they are."""
        nodes = self.at.local[0, :, self.own :]
        return Shot(
            pieces=tuple(np.bincount(self.run_of).tolist()),
            continuity=np.asarray(self.continuity(np.array([0]))[0]),
            sizes=self.node_sizes,
            nodes=tuple(nodes[(self.run_of == run) & self.follows] for run in range(len(self.runs))),
        )

    def keep(self, member: int) -> None:
        """Keeps this one of all members alone."""
        self.at, self.share = self.at.only([member]), self.share[[member]]

    def evaluate(self, shared, local, members) -> Iterator[Some]:
        """As of `Lanes`, of whole runs; pieces move along with the unknowns, to first order.

        Unless `closing`, rows are [J g r]: r will have changed by g once pieces join.
        """
        theta = np.concatenate([shared, local.reshape(len(shared), -1)], axis=1)
        here, failed = np.arange(len(members)), np.zeros(len(members), bool)
        for _ in range(_CLOSINGS if self.closing else 1):
            some = here[~failed]
            if self.closing:
                some = some[~((theta[some] == self.at.theta[members[some]]).all(axis=1) & self.closed(members[some]))]
            if not some.size:
                break
            failed[some] = ~self._move(theta[some], members[some])
        for run in range(len(self.runs)):
            rows = np.full((len(here), *self._shapes[run]), np.nan)
            for b in here[~failed]:
                rows[b] = self.at.rows[members[b], run]
            yield here, np.full(len(here), run), closed(rows, self.own + self.shared) if self.closing else rows

    def change(self, problem: Problem, sigma: np.ndarray, d: np.ndarray, members: np.ndarray) -> Float[np.ndarray, "members"]:
        """Return the change of all residuals by a step that closes the gaps, |J d + g|, in units of sigma."""
        d_shared, d_own = self.unknowns.split(d)
        squares = np.zeros(len(d))
        for (b, member), run in itertools.product(enumerate(members.tolist()), range(len(self.runs))):
            rows = self.at.rows[member, run]
            moved = rows[:, :-2] @ np.concatenate([d_own[b, run], d_shared[b]]) + rows[:, -2]
            for name, where in self.whole.group_of(run).channels.items():
                by = sigma[b, problem.estimated.index(name)] if name in problem.estimated else 1.0
                squares[b] += np.sum((moved[where] / by) ** 2)
        return np.sqrt(squares)

    def growth(self, members: np.ndarray) -> Float[np.ndarray, "members"]:
        """The factor by which small changes of the unknowns grow from the first node to where they are largest, in sizes of states and unknowns."""
        shared, own = self.unknowns.split(self.unknowns.sizes(self.at.theta[members]))
        sizes = np.concatenate([own[:, self.run_of], np.broadcast_to(shared[:, None], (len(shared), len(self.parts), self.shared))], axis=2)
        slopes = self.at.slopes[members][:, :, self.own :] * sizes[:, :, None] / self.node_sizes[:, None]
        lengths = np.sqrt(np.sum(slopes**2, axis=(2, 3)))[:, self.follows]
        return np.maximum(np.max(lengths, axis=1) / np.maximum(np.min(lengths, axis=1), np.finfo(float).tiny), 1.0)

    @contextmanager
    def unmoved(self) -> Iterator[None]:
        """A context in which unknowns may be tried anywhere: after it, the pieces are as they were before."""
        kept = self.at.only(range(len(self.at.theta)))  # a copy
        yield
        self.at = kept

    def closed(self, members: np.ndarray) -> Bool[np.ndarray, "members"]:
        """Whether the pieces join, to the tolerance of the simulation."""
        return self.continuity(members) <= 1.0

    def continuity(self, members: np.ndarray) -> Float[np.ndarray, "members"]:
        """Return the largest jump from one piece to the next, in tolerances of the options, `atol + rtol |x|`."""
        rtol, atol = self.tolerance
        allowed = atol + rtol * np.maximum(np.abs(self.at.local[members][..., self.own :]), self.node_sizes)
        return np.max(np.abs(self.at.jumps[members]) / allowed, axis=(1, 2), initial=0.0)

    def _move(self, theta: np.ndarray, members: np.ndarray) -> Bool[np.ndarray, "members"]:
        """Pieces of some members to other unknowns; which of them do not fail there. The others stay."""
        p, m, M = self.shared, self.own, self.own + self.states
        shared, own = self.unknowns.split(theta)
        d_shared, d_own = self.unknowns.split(theta - self.at.theta[members])
        d = np.concatenate([d_own[:, self.run_of], np.broadcast_to(d_shared[:, None], (len(theta), len(self.parts), p))], axis=2)
        local = self.at.local[members] + (self.at.slopes[members] @ d[..., None])[..., 0] + self.share[members][:, None, None] * self.at.gaps[members]
        local[:, ~self.follows, :m] = own
        for _ in self.evaluate_parts(shared, local, members):
            pass
        rows_of, ends = self.rows, self.ends
        slopes, gaps, jumps = np.zeros((len(theta), len(self.parts), M, m + p)), np.zeros(local.shape), np.zeros((*local.shape[:2], self.states))
        with np.errstate(over="ignore", invalid="ignore"):
            for i in range(len(self.parts)):
                if not self.follows[i]:
                    slopes[:, i, range(m), range(m)] = 1.0
                    continue
                before, end = slopes[:, i - 1], ends[:, i - 1]
                jumps[:, i] = end[..., -1] - local[:, i, m:]
                # ds_i = A ds_i-1 + B dtheta + c
                slopes[:, i, m:] = end[..., :M] @ before
                slopes[:, i, m:, m:] += end[..., M:-1]
                gaps[:, i, m:] = (end[..., :M] @ gaps[:, i - 1, :, None])[..., 0] + jumps[:, i]
                slopes[:, i, self._carried] = before[:, self._carried]
                gaps[:, i, self._carried] = gaps[:, i - 1, self._carried] + local[:, i - 1, self._carried] - local[:, i, self._carried]
            good = np.isfinite(slopes.sum(axis=(1, 2, 3)) + gaps.sum(axis=(1, 2)))
        for b in np.flatnonzero(good):
            rows = [self._condensed(run, rows_of[b], slopes[b], gaps[b]) for run in range(len(self.runs))]
            good[b] = all(np.isfinite(x.sum()) for x in rows)
            for run, x in enumerate(rows if good[b] else []):
                self.at.rows[members[b], run] = x
        here = members[good]
        self.at.local[here], self.at.theta[here], self.at.slopes[here], self.at.gaps[here] = local[good], theta[good], slopes[good], gaps[good]
        self.at.jumps[here] = jumps[good]
        return good

    def _condensed(self, run: int, rows_of: np.ndarray, slopes: np.ndarray, gaps: np.ndarray) -> Float[np.ndarray, "samples width"]:
        """[J g r] of a whole run from [J r], slopes and gaps of all pieces."""
        m, M = self.own, self.own + self.states
        found = np.zeros(self._shapes[run])
        for i in np.flatnonzero(self.run_of == run):
            of_piece, of_run = self._places[i]
            rows = rows_of[i][of_piece]
            J = rows[:, :M] @ slopes[i]
            J[:, m:] += rows[:, M:-1]
            found[of_run] = np.concatenate([J, (rows[:, :M] @ gaps[i])[:, None], rows[:, -1:]], axis=1)
        return found

    def _places_of(self, piece: int) -> tuple[np.ndarray, np.ndarray]:
        """Those residuals of a piece that belong to its run, and their places there."""
        run = int(self.run_of[piece])
        before = piece - int(np.flatnonzero(self.run_of == run)[0])
        first, firsts = self.ends_of[run][before], owned(self.runs[run], self.ends_of[run])
        of_piece, of_run = [], []
        for name, where in self.lanes.group_of(piece).channels.items():
            width = int(np.prod(self.runs[run].values[name].shape[1:]))
            begin, end = firsts[name][before : before + 2]
            samples = np.arange(width * begin, width * end)
            of_piece.append(where.start + samples - width * first)
            of_run.append(self.whole.group_of(run).channels[name].start + samples)
        return np.concatenate(of_piece), np.concatenate(of_run)


def problem_of(
    scene: Scene, runs: tuple[Experiment, ...], unknowns: Unknowns, options: AllOptions, members: int | None, loss: Loss, shooting: MultipleShooting | None
) -> tuple[Problem, Piecewise | None]:
    """Return the problem of these runs; where `shooting` says so, what works them out in pieces, too."""
    if shooting is None:
        return Problem(scene, runs, unknowns, Lanes(scene, runs, unknowns.layout, options, members), loss), None
    pieces = Piecewise(scene, runs, unknowns, options, shooting)
    return Problem(scene, runs, unknowns, pieces.whole, loss, pieces.evaluate), pieces
