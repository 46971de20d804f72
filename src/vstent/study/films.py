"""Stored contrast of a case folder, from which films along any direction are made."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from vstent.angiography.angiogram import AngiogramSettings, Watch, entering
from vstent.angiography.history import History, Recorder
from vstent.devices.stent import Stent
from vstent.errors import ReadError
from vstent.flow.case import FlowField
from vstent.geometry.vessel import Anatomy
from vstent.io.archive import load_data, save_data
from vstent.study.folder import CACHE, history_path
from vstent.study.ledger import ANATOMY, CONTRAST_VERSION, Ledger, anatomy_key, key_of
from vstent.study.repeat import finished_run
from vstent.study.stages import deploy_all


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
    def __call__(self, name: str, flow: Path, carrier_of: Callable[[], FlowField | None]) -> Iterator[Watch | None]:
        """Yield what watches the frames of a flow, or None where they are stored.

        Parameters
        ----------
        name : name of the flow.
        flow : its stored file.
        carrier_of : returns the flow, None where there is none.
        """
        path, key = history_path(flow), key_of(CONTRAST_VERSION, self.settings)
        kept = _kept(path, key)
        carrier = carrier_of() if kept is None else None
        if carrier is None:
            yield None
        else:
            bolus = self.settings.bolus
            recorder = Recorder(carrier, entering(bolus, carrier)[1], key, bolus.begin_s)
            yield recorder.watch
            kept = recorder.history()
            for former in path.parent.glob(f"contrast {name}-*.npz"):
                former.unlink()
            save_data(path, kept)
        if kept is not None:
            self.histories[name] = kept


def _kept(path: Path, key: str) -> History | None:
    """Return the stored contrast where it is that of an injection; None where there is none."""
    with suppress(ReadError):
        found = load_data(path, History)
        return found if found.key == key else None
    return None


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
    ledger = Ledger(out / CACHE, lambda *_: None)
    anatomy = load_data(out / CACHE / f"{ANATOMY}-{anatomy_key(source, study)}.npz", Anatomy)
    chosen = replace(study, treatments=tuple(one for one in study.treatments if one.name in set(names)))
    deployed = deploy_all(anatomy, chosen, ledger, source)[0] if chosen.treatments else {}
    return anatomy, {name: [one.stent for one in found.values()] for name, found in deployed.items()}
