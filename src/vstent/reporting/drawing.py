"""Draw the pictures of a case on threads, while its measures are computed."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Self

from numba import config

from vstent.reporting.figures import Picture, plates
from vstent.reporting.method import method_plates
from vstent.reporting.scene import Scene, scene_of

if TYPE_CHECKING:
    from vstent.study.pipeline import Computed


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
        self._of_method: list[Future[Picture]] = []

    def __enter__(self) -> Self:
        """Return the drawing."""
        return self

    def __exit__(self, *_: object) -> None:
        """Drop the pictures that are not begun."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def begin(self, case: "Computed") -> Scene:
        """Begin to draw all pictures of what a study has computed, unless this has been done; return its scene."""
        if self._scene is None:
            self._scene = scene_of(case.anatomy, case.implants, case.shown, case.yielded)
            self._begun = [self._pool.submit(plate.drawn) for plate in plates(self._scene)]
            of_method = method_plates(case.anatomy, case.implants, self._scene, case.whole)
            self._of_method = [self._pool.submit(plate.drawn) for plate in of_method]
        return self._scene

    def pictures(self) -> tuple[tuple[Picture, ...], tuple[Picture, ...]]:
        """Return the pictures of the results and those of the method, as soon as all of them are drawn."""
        return tuple(one.result() for one in self._begun), tuple(one.result() for one in self._of_method)
