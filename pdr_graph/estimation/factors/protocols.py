"""What a measurement kind may do beside the five methods of `Measurement`, and what initialisation needs of two kinds.

A class of this module is an interface by structure, as ``collections.abc.Sized`` is: ``isinstance(kind, Gated)`` is
True if the kind has the methods. (Such a check takes 0.2 µs; one of ``typing.Protocol`` 20 µs, a hundred times a step.)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self

from pdr_graph.estimation.factors.base import AnyArray, Measurement, Stage
from pdr_graph.types import Array, Fixes, FixReport, Headings, Index, Mask

if TYPE_CHECKING:
    from pdr_graph.estimation.ambiguity.hypothesis import Proposal
    from pdr_graph.estimation.factors.chain import Evaluation


class Structural(ABC):  # noqa: B024, its subclasses have the methods
    """Base of the interfaces: their subclasses are all classes that have their methods."""

    @classmethod
    def __subclasshook__(cls, other: type) -> Any:
        if cls is Structural:
            return NotImplemented
        return all(hasattr(other, name) for name in cls.__abstractmethods__)


class Itemized(Structural):
    """A kind with a report for each instance; other kinds have summaries."""

    @property
    @abstractmethod
    def instances(self) -> tuple[Index, Array]:
        """Numbers and times ``(n,)`` [s] of the instances that have a report, in the order of the reports."""


class OnPlan(Structural):
    """A kind whose instances belong to rooms or corridors of the floor plan."""

    @abstractmethod
    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Associate instances with rooms or corridors along the walk ``at``.

        stray: sigma of that walk, everywhere or at the end of each piece ``(m,)`` [m]; alike: number of pieces in a row
        with the same error.
        """


class Priced(Structural):
    """A kind whose association with regions of the plan has a price."""

    @abstractmethod
    def same_association(self, other: Measurement) -> bool:
        """True if ``other``, a version of the same kind, has the same rooms or corridors."""
        ...

    @property
    @abstractmethod
    def price(self) -> float:
        """Cost of the association in addition to the residuals, in units of half a squared sigma."""


class Staged(Structural):
    """A kind that is tighter or looser in some stages of the search."""

    @abstractmethod
    def staged(self, stage: Stage) -> Self:
        """The version for a stage of the search."""
        ...


class Multimodal(Structural):
    """A kind one of whose local optima hides another."""

    @abstractmethod
    def alternatives(self) -> Sequence[Self]:
        """Versions from whose optima the search must also start."""
        ...


class Initialized(Structural):
    """A kind whose unknown variables start from the initial walk."""

    @abstractmethod
    def initialized(self, poses: Array) -> Self:
        """Initialise unknown variables from the initial poses ``(k + 1, 3)`` (positions of unlisted beacons)."""
        ...


class Restarted(Structural):
    """A kind that depends on where the search starts."""

    @abstractmethod
    def restarted(self, poses: Array) -> Self:
        """Adapt to a search that starts at other poses ``(k + 1, 3)``."""
        ...


class Locating(Structural):
    """A kind from which positions can be read before the walk is solved."""

    @abstractmethod
    def rough_fixes(self) -> Fixes:
        """Positions to start from where the walk has no fix."""
        ...


class Refined(Structural):
    """A kind that is modelled better once a first optimum is known."""

    @abstractmethod
    def refined(self, at: Evaluation) -> Measurement:
        """The second pass: outliers lose weight, common errors are modelled. ``self`` if nothing changes."""
        ...


class Gated(Structural):
    """A kind whose instances may be outliers of a walk under way."""

    @abstractmethod
    def reclassified(self, at: Evaluation) -> Self:
        """Lower the weight of instances far from the walk, and restore it for those that are near again."""
        ...

    @property
    @abstractmethod
    def diverged(self) -> bool:
        """True if its last instances agree with one another and all lie far from the walk: the estimate diverged."""

    @abstractmethod
    def contradicts(self, decisions: Mapping[str, AnyArray]) -> bool:
        """True if instances that were used before are now inconsistent with the others."""
        ...


class Remembered(Structural):
    """A kind that decides about its instances, in a way that a walk under way must remember."""

    @abstractmethod
    def decisions(self) -> dict[str, AnyArray]:
        """Decisions about its instances, for `continued`; empty if there are none."""
        ...

    @abstractmethod
    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Apply earlier decisions to the instances that are still there."""
        ...


class Doubted(Structural):
    """A kind that may err beyond what it states."""

    @abstractmethod
    def hypotheses(self, at: Evaluation, by_others: Callable[[], Evaluation] | None) -> Sequence[Proposal]:
        """What may be wrong with the instances, so that they fit better than at ``at``; the most promising first.

        by_others: returns the walk by the other sources alone; None if these do not determine its place.
        """
        ...


class Positions(Protocol):
    """The fixes of a walk with the classification of each, ``f`` of them."""

    def __len__(self) -> int: ...

    @property
    def name(self) -> str:
        """Name of the kind."""
        ...

    @property
    def fixes(self) -> Fixes:
        """All fixes."""
        ...

    @property
    def keyframe(self) -> Index:
        """The keyframe of each fix ``(f,)``, −1 outside the walk."""
        ...

    @property
    def sigma(self) -> Array:
        """Sigma ``(f,)`` per axis [m], wider outside the recording."""
        ...

    @property
    def independent_sigma(self) -> Array:
        """Sigma ``(f,)`` [m], wider, so that correlated fixes of one receiver may be treated as independent."""
        ...

    @property
    def used(self) -> Mask:
        """True ``(f,)`` for fixes that measure the walk: new, not frozen, not far outside the recording."""
        ...

    @property
    def consistent(self) -> Mask:
        """True ``(f,)`` for fixes in the longest chain that one walk can have made."""
        ...

    @property
    def outlier(self) -> Mask:
        """True ``(f,)`` for fixes far from the first optimum."""
        ...

    @property
    def held(self) -> Mask:
        """True ``(f,)`` for fixes that have a factor."""
        ...

    @property
    def duplicate(self) -> Mask:
        """True ``(f,)`` for epochs that repeat the one before."""
        ...

    @property
    def still(self) -> Mask:
        """True ``(f,)`` for fixes of a receiver that held its position while the walk went on."""
        ...

    @property
    def approximate(self) -> bool:
        """True if the fixes only initialise the search."""
        ...

    def rejected(self, number: Index) -> Measurement:
        """Mark the fixes with these numbers as outliers."""
        ...

    def misplaced(self, sigma: float) -> Measurement:
        """The same fixes with an error of ``sigma`` [m] per axis in addition to theirs."""
        ...

    def reports(self, at: Evaluation, which: Index | None = None) -> tuple[FixReport, ...]:
        """Residual, weight and reason of every fix, or of the fixes ``which``."""
        ...

    def reported(
        self, distance: Array, sigmas: Array, weight: Array, origin: str, which: Index | None = None
    ) -> tuple[FixReport, ...]:
        """Reports of fixes, all or ``which``, at ``distance (f,)`` [m], in ``sigmas (f,)``, from ``origin``."""
        ...


class Directions(Protocol):
    """The headings of a walk: walking directions of a compass or of the user, ``h`` of them."""

    @property
    def headings(self) -> Headings:
        """The headings during the recording."""
        ...

    @property
    def keyframe(self) -> Index:
        """The keyframe of each heading ``(h,)``, −1 outside the walk."""
        ...


def decisions_of(kind: Measurement) -> dict[str, AnyArray]:
    """The decisions of a kind about its instances; empty for kinds that decide nothing."""
    return kind.decisions() if isinstance(kind, Remembered) else {}
