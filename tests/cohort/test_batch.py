"""A cohort: one table whatever happens to whom; workers are killed, and the table is the same."""

import csv
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest
from stated import NECK, OUTLETS, STATED, needed

from vstent import phantoms
from vstent.cli import main
from vstent.cohort import batch
from vstent.cohort.batch import COST, LOST, collect, flat_metrics, left_to_do, read_rows, run_cohort, work
from vstent.cohort.cases import COLUMNS, find_cases
from vstent.cohort.estimate import START_CPU_S, estimate
from vstent.devices.treatment import with_device
from vstent.errors import FlowError, InputError, ReadError, VstentError
from vstent.flow.settings import FlowSettings, Numerics
from vstent.io.tables import write_parquet, write_rows
from vstent.io.writers import write_stl
from vstent.reporting.cohort import cohort_report, modified_z_scores
from vstent.study.folder import CACHE
from vstent.study.pipeline import run as run_study
from vstent.study.settings import AnatomySettings, InputSettings, settings_of
from vstent.study.store import Key, Store
from vstent.study.workers import DaskCluster, Processes, Slurm

TREATMENTS = (with_device("leo"), with_device("enterprise", center_mm=27.0))
"""Devices with few wires: the Enterprise lies within an artery of 44 mm, and beyond the end of one of 11 mm that is
continued to 31.5 mm."""
GIVEN = {"treatment": TREATMENTS, "no-flow": True, "units": "mm"}
SETTINGS = settings_of(GIVEN)

needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="Dask is not installed")


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """An artery with a sac, one too short for the Enterprise where it is placed, and a file that is no surface."""
    folder = tmp_path_factory.mktemp("scäns of a cohort")
    for name, length_mm in (("a", 44.0), ("b", 11.0)):
        artery = phantoms.with_sac(
            phantoms.tube(length_mm=length_mm), abscissa_mm=0.5 * length_mm, width_mm=5.0, neck_mm=3.5
        )
        write_stl(folder / f"{name}.stl", phantoms.phantom_surface(artery, edge_mm=0.7))
    (folder / "c.stl").write_text("no surface")
    (folder / "notes.txt").write_text("no case")
    return folder


@pytest.fixture(scope="module")
def table(scans, tmp_path_factory):
    """The cohort's rows, computed one case after another in this process."""
    out = tmp_path_factory.mktemp("alone")
    cases = find_cases(scans, GIVEN)
    for task in left_to_do(cases, out):
        work(task)
    return bare(collect(cases, out))


def bare(rows):
    return [{key: value for key, value in row.items() if key not in COST} for row in rows]


def stored_row(folder, treatment):
    """The file with the row of a treatment in the folder of a case."""
    (file,) = (folder / CACHE).glob(f"{treatment}-*.json")
    return file


def told(done, total, name, rows):
    pass


def killed(task):
    """Die as a worker does that runs out of memory, in the middle of case c."""
    if task.case.name == "c":
        os.kill(os.getpid(), signal.SIGKILL)
    work(task)


def held(task):
    """Do every case but c, which waits until its worker is killed."""
    while task.case.name == "c":
        time.sleep(0.1)
    work(task)


def test_the_table_has_a_row_a_case_and_device_with_every_metric_or_the_failure(scans, table, tmp_path):
    assert [(row["case"], row["treatment"]) for row in table] == [(c, d) for c in "abc" for d in SETTINGS.devices]
    by_name = {(row["case"], row["treatment"]): row for row in table}
    study = run_study(scans / "a.stl", tmp_path / "a", SETTINGS, lambda *_: None)
    for device in SETTINGS.devices:
        row = by_name["a", device]
        wanted = json.loads(json.dumps(flat_metrics(study.metrics, device)))
        assert {key: row[key] for key in wanted} == wanted
        assert row["outcome"] == "done"
        assert row["sentence"] == study.implants[device][device].advice
    assert by_name["b", "leo"]["outcome"] == "done"
    assert by_name["b", "enterprise"]["outcome"] == "failed"
    assert by_name["b", "enterprise"]["stage"] == "deploy enterprise"
    assert "beyond the distal end" in by_name["b", "enterprise"]["sentence"]
    for device in SETTINGS.devices:
        assert by_name["c", device]["outcome"] == "failed"
        assert by_name["c", device]["stage"] == "segment"
        assert "not a .stl" in by_name["c", device]["sentence"]


def test_a_device_whose_flow_fails_leaves_the_files_of_the_others(scans, tmp_path, monkeypatch):
    def failing(out, anatomy, deployments, *_):
        if "enterprise" in deployments:
            raise FlowError("it diverged")
        return {}, {}

    monkeypatch.setattr("vstent.study.stages.compute_flows", failing)
    (case, *_) = find_cases(scans, GIVEN)
    (task,) = left_to_do([case], tmp_path, keeps_files=True)
    work(task)
    kept = json.loads((task.folder / "study" / "metrics.json").read_text())
    assert list(kept["treatments"]) == ["leo"]
    assert [path.name for path in (task.folder / "study" / "treatments").iterdir()] == ["leo"]


@pytest.mark.system
def test_a_worker_killed_midway_is_replaced_and_the_table_is_the_same(scans, table, tmp_path):
    cases = find_cases(scans, GIVEN)
    victims = []

    def kill_one():
        while not victims:
            for child in active_children():
                time.sleep(1.0)
                victims.append(child.pid)
                os.kill(child.pid, signal.SIGKILL)
                return
            time.sleep(0.01)

    killer = threading.Thread(target=kill_one)
    killer.start()
    run_cohort(left_to_do(cases, tmp_path), tmp_path, Processes(2), told)
    killer.join()
    assert victims
    assert bare(collect(cases, tmp_path)) == table


@pytest.mark.system
def test_a_case_whose_process_always_dies_costs_only_itself_and_is_done_by_the_next_run(
    scans, table, tmp_path, monkeypatch
):
    monkeypatch.setattr(batch, "work", killed)
    cases = find_cases(scans, GIVEN)[1:]
    run_cohort(left_to_do(cases, tmp_path), tmp_path, Processes(2), told)
    rows = collect(cases, tmp_path)
    assert [row["outcome"] for row in rows] == ["done", "failed", LOST, LOST]
    assert "killed by signal 9" in rows[2]["sentence"]
    assert bare(rows)[:2] == table[2:4]
    (task,) = left_to_do(cases, tmp_path)
    assert task.case.name == "c"
    work(task)
    assert bare(collect(cases, tmp_path)) == table[2:]


def test_a_second_run_does_only_what_is_missing(scans, table, tmp_path):
    cases = find_cases(scans, GIVEN)
    for case in cases:
        for device, key in case.keys.items():
            row = next(row for row in table if (row["case"], row["treatment"]) == (case.name, device))
            Store(tmp_path / "cases" / case.name / CACHE).write(device, key, {}, values=row)
    assert left_to_do(cases, tmp_path) == []
    # one row damaged, one input changed, one more device: just these are missing
    stored_row(tmp_path / "cases" / "a", "leo").write_text('{"values": ')
    changed = [replace(case, path=scans / "a.stl") if case.name == "b" else case for case in cases]
    treatments = (*TREATMENTS, with_device("pipeline"))
    more = [replace(c, settings=replace(c.settings, treatments=treatments)) for c in changed]
    missing = {task.case.name: task.case.settings.devices for task in left_to_do(more, tmp_path)}
    assert missing == {"a": ("leo", "pipeline"), "b": ("leo", "enterprise", "pipeline"), "c": ("pipeline",)}
    # another threshold is another study
    other = [replace(cases[0], settings=replace(SETTINGS, input=InputSettings("mm", threshold=100.0)))]
    assert left_to_do(other, tmp_path)[0].case.settings.devices == SETTINGS.devices


def test_the_command_writes_the_table_twice_and_a_report(scans, table, tmp_path, capsys):
    out = tmp_path / "out"
    listed = tmp_path / "cohort.csv"
    listed.write_text(f"case,input,device,at\nfirst,{scans / 'a.stl'},leo,\nlast,{scans / 'c.stl'},,\n")
    command = ["batch", str(listed), "--out", str(out), "--no-flow", "--units", "mm", "--device", "enterprise"]
    assert main([*command, "--jobs", "2", "--keep-files"]) == 1  # the last case fails
    said = capsys.readouterr()
    assert "1 of 2 rows are not done" in said.err
    assert "2 cases, 2 rows; 2 cases to do: about 1 min" in said.out
    with (out / "cohort.csv").open(newline="") as file:
        first, last = csv.DictReader(file)
    assert (first["case"], first["treatment"], first["outcome"]) == ("first", "leo", "done")
    assert (last["treatment"], last["outcome"], last["stage"]) == ("enterprise", "failed", "segment")
    alone = next(row for row in table if (row["case"], row["treatment"]) == ("a", "leo"))
    key = "implant.deployed_length_mm"
    assert float(first[key]) == pytest.approx(alone[key], rel=1e-5)
    study = json.loads((out / "cases" / "first" / "study" / "metrics.json").read_text())
    (implant,) = study["treatments"]["leo"]["implants"].values()
    assert implant["deployed_length_mm"] == pytest.approx(alone[key], rel=1e-5)
    page = (out / "cohort.html").read_text()
    assert last["sentence"] in page.replace("&#39;", "'")
    assert re.findall(r'alt="(.*?)"', page) == ["leo in the artery of first"]  # the other case has no device
    assert main([*command, "--jobs", "2"]) == 1
    assert "0 cases to do" in capsys.readouterr().out


def test_parquet_holds_what_the_rows_hold(table, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    assert write_parquet(tmp_path / "t.parquet", table)
    found = parquet.read_table(tmp_path / "t.parquet").to_pylist()
    assert [{key: value for key, value in row.items() if value is not None} for row in found] == table


BAD_LISTS = {
    "an unknown column": ("input,sac\na.stl,1\n", "column 'sac'"),
    "no input": ("case\nfirst\n", "has no input"),
    "a point of two numbers": ("input,at\na.stl,1 2\n", "column at: '1 2' is not 3 numbers"),
    "a threshold in words": ("input,threshold\na.stl,high\n", "column threshold: 'high' is not a number"),
    "a threshold that is no number": ("input,threshold\na.stl,500\na.stl,nan\n", "line 3 of"),
    "an endless size": ("input,diameter\na.stl,inf\n", "column diameter: 'inf' is not a number"),
    "a point that is nowhere": ("input,at\na.stl,1 nan 3\n", "column at: '1 nan 3' is not 3 numbers"),
    "a size below zero": (
        "input,length\na.stl,-4\n",
        "column length: -4 mm is out of range: give above 0, up to 1000 mm",
    ),
    "half an inlet": ("input,inlet\na.stl,1 2 3; 4\n", "column inlet: '4' is not 3 numbers"),
    "voxels without an edge": ("input,spacing\na.raw,0.1 0 1\n", "column spacing: 0 mm is out of range"),
    "no voxels": ("input,shape\na.raw,10 0 10\n", "column shape: 0 is out of range: give 1 to 100000"),
    "a unit of fields": ("input,units\na.stl,furlong\n", "column units: 'furlong' is not one of m, cm, mm"),
    "a flag that is neither": ("input,gpu\na.stl,maybe\n", "column gpu: 'maybe' is not yes or no"),
    "a treatment of nothing": ("input,treatment\na.stl,+\n", "column treatment: '+' lacks a device before or after +"),
    "a neck that is nowhere": ("input,neck\na.stl,neck.csv\n", "list.csv: "),
    "a range of nothing": ("input,vary-landing\na.stl,2\n", "list.csv: --vary-landing needs --uncertainty N"),
    "an unknown engine": ("input,engine,no-flow\na.stl,steam,no\n", "There is no 'steam'"),
    "a name with a slash": ("case,input\n../up,a.stl\n", "without slashes"),
    "one name twice": ("case,input\nx,a.stl\nx,b.stl\n", "two cases called x"),
    "no case at all": ("case,input\n", "holds no case"),
    "one device twice": ("input,device\na.stl,silk silk\n", "list.csv: two treatments are called silk"),
    "a device that does not exist": ("input,device\na.stl,slik\n", "silk"),
}


@pytest.mark.parametrize("name", BAD_LISTS)
def test_a_bad_list_is_refused_before_anything_is_done(name, tmp_path, capsys):
    text, said = BAD_LISTS[name]
    (tmp_path / "list.csv").write_text(text)
    assert main(["batch", str(tmp_path / "list.csv"), "--out", str(tmp_path / "out"), "--no-flow"]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_columns_are_the_options():
    assert sorted(COLUMNS) == sorted(["case", "input", *STATED])


@pytest.mark.parametrize("column", STATED)
def test_a_cell_reaches_its_setting(column, tmp_path, monkeypatch):
    monkeypatch.setattr("vstent.cohort.cases.check_engine", lambda flow, runs_here: None)  # there may be no GPU
    (tmp_path / "neck.csv").write_text(NECK)
    (tmp_path / "outlets.csv").write_text(OUTLETS)
    text, expected = STATED[column]
    rows = [{"input": "a.stl", "case": "first", column: text}, {"input": "a.stl", "case": "last"}]
    write_rows(tmp_path / "list.csv", rows)
    first, last = find_cases(tmp_path / "list.csv", needed(column))
    assert first.settings == expected
    assert last.settings == settings_of(needed(column)) != expected  # an empty cell takes what holds for all


def test_a_row_joins_what_it_states_to_what_holds_for_all(tmp_path):
    """Points are in the frame of the row, and sizes belong to the devices for all."""
    (tmp_path / "list.csv").write_text("input,frame,at,length\na.stl,ras,1 2 3,18\n")
    (found,) = find_cases(tmp_path / "list.csv", {"device": ["silk"], "diameter": 4.0, "outlet": (4.0, 5.0, 6.0)})
    assert found.settings.treatments == (with_device("silk", diameter_mm=4.0, length_mm=18.0),)
    assert found.settings.anatomy == AnatomySettings(at_mm=(-1.0, -2.0, 3.0), outlet_mm=(-4.0, -5.0, 6.0))


def test_a_folder_holds_its_surfaces_scans_and_series(scans, tmp_path):
    assert [case.name for case in find_cases(scans, GIVEN)] == ["a", "b", "c"]
    series = tmp_path / "cohort" / "patient 1"
    series.mkdir(parents=True)
    (series / "IM0001").write_bytes(b"")
    (tmp_path / "cohort" / "empty").mkdir()
    (tmp_path / "cohort" / "two.nii.gz").write_bytes(b"")
    assert [case.name for case in find_cases(tmp_path / "cohort", GIVEN)] == ["patient 1", "two"]
    with pytest.raises(ReadError, match="does not exist"):
        find_cases(tmp_path / "none", GIVEN)


def test_an_estimate_grows_with_cases_devices_and_flow_and_heeds_memory(scans, monkeypatch):
    cases = find_cases(scans, GIVEN)
    one, all_three = estimate(cases[:1], 2), estimate(cases, 2)
    assert one.cpu_s > START_CPU_S
    assert all_three.cpu_s > 2 * one.cpu_s
    flowing = [replace(case, settings=replace(SETTINGS, flow=FlowSettings())) for case in cases]
    assert estimate(flowing, 2).cpu_s > 10 * all_three.cpu_s
    calibrated = FlowSettings(numerics=Numerics(wires="calibrated"))
    in_rounds = [replace(case, settings=replace(SETTINGS, flow=calibrated)) for case in cases]
    of_flows = [estimate(those, 2).cpu_s - all_three.cpu_s for those in (flowing, in_rounds)]
    assert of_flows[1] == pytest.approx(7 / 3 * of_flows[0])  # each of two devices has two rounds besides
    monkeypatch.setattr(sys.modules["vstent.cohort.estimate"], "free_memory_bytes", lambda: 3.5e6 * one.memory_MB)
    assert estimate(cases[:1], 8).jobs == 3


def test_outliers_are_found_by_the_modified_z_score():
    values = [1.0, 2.0, 3.0, 4.0, 5.0, 40.0]
    away = np.abs(np.array(values) - 3.5)
    wanted = 0.6745 * (np.array(values) - 3.5) / np.median(away)
    assert modified_z_scores(values) == pytest.approx(wanted)
    key = "implant.deployed_length_mm"
    rows = [{"case": f"<c{i}>", "treatment": "silk", "outcome": "done", key: v} for i, v in enumerate(values)]
    page = cohort_report("x", rows, {})
    outliers = page[page.index('id="outliers"') : page.index('id="failures"')]
    assert re.findall(r'<th scope="row">(.*?)</th>', outliers) == ["&lt;c5&gt;"]
    assert page.count("<circle") == 6
    assert page.count("class=apart") == 1
    assert "://" not in page


@pytest.mark.system
@needs_dask
def test_a_dask_worker_killed_midway_gives_the_same_table_and_a_lost_scheduler_keeps_what_is_done(
    scans, table, tmp_path, monkeypatch
):
    cases = find_cases(scans, GIVEN)
    with Scheduler(tmp_path) as scheduler:
        scheduler.add_worker()
        victim = scheduler.add_worker()
        # the worker dies with a case in its hands, as soon as another case is done
        run_cohort(left_to_do(cases, tmp_path), tmp_path, DaskCluster(scheduler.address), lambda *_: victim.kill())
        assert bare(collect(cases, tmp_path)) == table
        # the scheduler itself is lost as soon as one case is done
        for device in SETTINGS.devices:
            for name in "bc":
                stored_row(tmp_path / "cases" / name, device).unlink()
        tasks = left_to_do(cases, tmp_path)
        monkeypatch.setattr(batch, "work", held)
        with pytest.raises(VstentError, match="scheduler was lost"):
            run_cohort(tasks, tmp_path, DaskCluster(scheduler.address), lambda *_: scheduler.process.kill())
    monkeypatch.undo()
    assert [task.case.name for task in left_to_do(cases, tmp_path)] == ["c"]
    run_cohort(left_to_do(cases, tmp_path), tmp_path, Processes(1), told)
    assert bare(collect(cases, tmp_path)) == table


@needs_dask
def test_no_scheduler_is_told_in_a_sentence(scans, tmp_path, monkeypatch):
    monkeypatch.setattr("vstent.study.workers.SCHEDULER_S", 0.5)
    with pytest.raises(InputError, match="No Dask scheduler answers"):
        list(DaskCluster("tcp://127.0.0.1:9").do(work, left_to_do(find_cases(scans, GIVEN), tmp_path)))


def test_a_slurm_job_asks_for_twice_the_memory_foreseen_and_holds_one_case():
    pytest.importorskip("dask_jobqueue")
    with Slurm(3, 412.4).cluster() as cluster:
        script = cluster.job_script()
    assert float(re.search(r"--mem=(\d+)M", script)[1]) == pytest.approx(2 * 412.4e6 / 2**20, abs=1)
    assert "#SBATCH --cpus-per-task=1" in script
    assert "--nthreads 1" in script


def test_without_slurm_nothing_is_sent_and_a_scheduler_beside_it_is_refused(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.stl").write_text("no surface")
    monkeypatch.setenv("PATH", str(tmp_path))
    command = ["batch", str(tmp_path), "--out", str(tmp_path / "out"), "--no-flow", "--slurm"]
    assert main(command) == 2
    assert "no `sbatch` on the PATH" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit, match="2"):
        main([*command, "--scheduler", "tcp://head:8786"])
    assert "not allowed with argument --slurm" in capsys.readouterr().err


QUEUE = {
    "sbatch": 'job=$(cat "$1")\nsetsid sh -c "$job" >/dev/null 2>&1 &\necho $! >> {log}; echo "Submitted batch job $!"',
    "scancel": "kill -9 -- -$1",
}
"""A queue of Slurm's commands that starts every job at once."""


@pytest.mark.system
@needs_dask
def test_slurm_jobs_that_the_queue_ends_are_asked_for_anew(scans, table, tmp_path, monkeypatch):
    pytest.importorskip("dask_jobqueue")
    log = tmp_path / "jobs"
    for name, script in QUEUE.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{script.format(log=log)}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.chdir(tmp_path)
    cases = find_cases(scans, GIVEN)

    def ended(done, *_):
        if done == 1:
            os.killpg(int(log.read_text().split()[-1]), signal.SIGKILL)

    run_cohort(left_to_do(cases, tmp_path / "out"), tmp_path / "out", Slurm(1, 400.0), ended)
    assert bare(collect(cases, tmp_path / "out")) == table
    assert len(log.read_text().split()) > 1


class Scheduler:
    """A Dask scheduler and its workers, each a process of its own."""

    def __init__(self, folder):
        self.folder = folder
        self.processes = []

    def __enter__(self):
        file = self.folder / "scheduler.json"
        options = ["--port", "0", "--no-dashboard", "--host", "127.0.0.1", "--scheduler-file", str(file)]
        self.process = self._start("dask_scheduler", options)
        while not (file.exists() and file.stat().st_size):
            assert self.process.poll() is None
            time.sleep(0.05)
        self.address = json.loads(file.read_text())["address"]
        return self

    def add_worker(self):
        options = [self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        return self._start("dask_worker", [*options, "--local-directory", str(self.folder), "--death-timeout", "30"])

    def _start(self, module, options):
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
        log = (self.folder / f"{module}-{len(self.processes)}.log").open("wb")
        with log:
            command = [sys.executable, "-m", f"distributed.cli.{module}", *options]
            process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        self.processes.append(process)
        return process

    def __exit__(self, *_):
        for process in self.processes:
            process.kill()
            process.wait()


def test_rows_of_another_key_are_not_believed(tmp_path):
    key = Key(12 * "1", 12 * "a")
    Store(tmp_path / CACHE).write("silk", key, {}, values={"outcome": "done"})
    assert read_rows(tmp_path, {"silk": key, "leo": key}) == {"silk": {"outcome": "done"}}
    assert read_rows(tmp_path, {"silk": key._replace(code=12 * "b")}) == {}
