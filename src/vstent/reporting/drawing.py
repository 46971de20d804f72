"""Draw the pictures of a case on threads, while its measures are computed."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self, TypeVar

from numba import config

from vstent.flow.case import FlowField
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.reporting.figures import Picture, plates
from vstent.reporting.method import method_plates
from vstent.reporting.scene import Implants, Scene, scene_of

Item = TypeVar("Item")
Found = TypeVar("Found")


def in_threads(call: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
    """Return the results of a call for every item, computed on as many threads as the kernels use.

    Parameters
    ----------
    call : what is computed; most of its time must be spent in code that lets other threads run.
    items : its arguments.
    """
    with ThreadPoolExecutor(config.NUMBA_NUM_THREADS) as pool:
        return list(pool.map(call, items))


class Drawing:
    """Scene and pictures of a case.

    `begin` draws on threads and returns at once, so that a study continues meanwhile. As a context manager it drops the
    pictures not yet begun where the study fails. The threads run no parallel kernel, because not every threading layer
    of numba allows two of these at once.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(config.NUMBA_NUM_THREADS)
        self._scene: Scene | None = None
        self._begun: list[Future[Picture]] = []

    def __enter__(self) -> Self:
        """Return the drawing."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Drop the pictures that are not begun."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def begin(
        self,
        anatomy: Anatomy,
        implants: Implants,
        fields: Mapping[str, FlowField],
        whole: Vessel | None,
    ) -> Scene:
        """Begin to draw all pictures of a case, unless this has been done; return its scene.

        Parameters
        ----------
        anatomy : vessel, parent artery and sacs.
        implants : deployed implants by treatment and id.
        fields : flows by treatment; empty: no flow is shown.
        whole : the vessel before it was trimmed; None: it is not shown.
        """
        if self._scene is None:
            self._scene = scene_of(anatomy, implants, fields)
            before, *after = plates(self._scene)
            wanted = [before, *method_plates(anatomy, implants, self._scene, whole), *after]
            self._begun = [self._pool.submit(plate.drawn) for plate in wanted]
        return self._scene

    def pictures(self) -> tuple[Picture, ...]:
        """Return the pictures in the order of the report, as soon as all of them are drawn."""
        return tuple(one.result() for one in self._begun)
