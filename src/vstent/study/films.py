"""Stored contrast of a case folder, from which films along any direction are made."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from vstent.angiography.angiogram import AngiogramSettings, Watch, entering
from vstent.angiography.history import History, Recorder
from vstent.devices.stent import Stent
from vstent.flow.case import FlowField
from vstent.geometry.vessel import Anatomy
from vstent.study.folder import CACHE
from vstent.study.keys import angiogram_key, study_keys
from vstent.study.repeat import finished_run
from vstent.study.stages import deploy_all, finished_anatomy
from vstent.study.store import Key, Store


@dataclass(frozen=True)
class Recording:
    """Stores the contrast of every flow while it is computed, and finds it again (`vstent.study.contrast.Record`).

    Contrast that is stored for the same flow and injection is not recorded again.
    """

    settings: AngiogramSettings
    """Settings of the angiograms."""
    histories: dict[str, History] = field(default_factory=dict)
    """Contrast by name of the flow; filled by the calls."""

    @contextmanager
    def __call__(
        self, name: str, flow: Key, store: Store, carrier_of: Callable[[], FlowField | None]
    ) -> Iterator[Watch | None]:
        """Yield what watches the frames of a flow, or None where they are stored."""
        stage, key = f"contrast {name}", str(angiogram_key(flow, self.settings))
        kept = store.peek(stage, flow, History)
        kept = kept if kept is not None and kept.key == key else None
        carrier = carrier_of() if kept is None else None
        if carrier is None:
            yield None
        else:
            bolus = self.settings.bolus
            recorder = Recorder(carrier, entering(bolus, carrier)[1], key, bolus.begin_s)
            yield recorder.watch
            kept = recorder.history()
            store.keep(stage, flow, kept)
        if kept is not None:
            self.histories[name] = kept


def stents_of(out: Path, names: Iterable[str]) -> tuple[Anatomy, dict[str, list[Stent]]]:
    """Return the anatomy of a finished case folder, and the implants as its run deployed them, by treatment.

    Parameters
    ----------
    out : the case folder.
    names : treatments to deploy.

    Raises
    ------
    ReadError
        The folder holds no finished run of this version.
    """
    source, study = finished_run(out)
    store, keys = Store(out / CACHE), study_keys(source, study)
    anatomy = finished_anatomy(out, store, keys)
    chosen = replace(study, treatments=tuple(one for one in study.treatments if one.name in set(names)))
    deployed = deploy_all(anatomy, chosen, store, keys)[0] if chosen.treatments else {}
    return anatomy, {name: [one.stent for one in found.values()] for name, found in deployed.items()}
