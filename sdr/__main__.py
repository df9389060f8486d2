"""The command line, ``gnssbb``.

Nothing heavy is imported here: each command imports what it needs, so that ``--help`` answers at once.
"""

import json as jsonlib
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Parameter

from sdr import SCHEMA_VERSION, version
from sdr.options import Json, Out, Recording, Set, Threads

app = App(
    name="gnssbb",
    version=version,
    help="GNSS baseband simulator and software receiver: IF samples in or made, tracking, position, monitors.",
    help_format="plaintext",
)


@app.command
def run(
    scenario: str,
    /,
    *,
    output: Out = None,
    plots: Annotated[bool, Parameter(negative="", help="Draw the figures beside the results.")] = False,
    json: Json = False,
    set_: Set = [],  # noqa: B006
    threads: Threads = 1,
) -> None:
    """Synthesise a scenario and receive it in one stream; no IF file is needed.

    SCENARIO is a TOML file or the name of a built-in one (see: gnssbb scenarios).
    """
    from sdr import jobs

    _report(
        "run",
        jobs.run(scenario, output=output, overrides=set_, threads=threads, plots=plots, quiet=json),
        json,
    )


@app.command
def simulate(
    scenario: str,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Recording to write (base name).")],
    json: Json = False,
    set_: Set = [],  # noqa: B006
    threads: Threads = 1,
) -> None:
    """Write a scenario's IF samples as a recording with metadata, and the truth in HDF5 beside it."""
    from sdr import jobs

    _report("simulate", jobs.simulate(scenario, output, overrides=set_, threads=threads, quiet=json), json)


@app.command
def receive(
    file: Path,
    /,
    *,
    recording: Recording = Recording(),
    scenario: Annotated[str | None, Parameter(help="Scenario whose [receiver] section is used.")] = None,
    imu: Annotated[Path | None, Parameter(help="CSV of an IMU, aligned to the first sample.")] = None,
    odometer: Annotated[Path | None, Parameter(help="CSV of an odometer.")] = None,
    barometer: Annotated[Path | None, Parameter(help="CSV of a barometer.")] = None,
    output: Out = None,
    plots: Annotated[bool, Parameter(negative="", help="Draw the figures beside the results.")] = False,
    json: Json = False,
    set_: Set = [],  # noqa: B006
    threads: Threads = 1,
) -> None:
    """Receive a recording: acquire, track, decode and fix the position."""
    from sdr import jobs

    result = jobs.receive(
        file,
        recording,
        scenario,
        output=output,
        overrides=set_,
        threads=threads,
        plots=plots,
        quiet=json,
        imu=imu,
        odometer=odometer,
        barometer=barometer,
    )
    _report("receive", result, json)


@app.command
def acquire(
    file: Path,
    /,
    *,
    recording: Recording = Recording(),
    signals: Annotated[list[str], Parameter(help="Signals to search: L1CA, E1C.")] = ["L1CA", "E1C"],  # noqa: B006
    doppler_hz: Annotated[float | None, Parameter(help="Search Doppler from minus to plus this.")] = None,
    p_fa: Annotated[
        float | None, Parameter(help="False-alarm probability over one satellite's whole search.")
    ] = None,
    json: Json = False,
) -> None:
    """Search a recording for satellites."""
    from sdr import jobs

    _report("acquire", jobs.acquire(file, recording, signals, doppler_hz, p_fa), json)


@app.command
def probe(
    file: Path,
    /,
    *,
    recording: Recording = Recording(),
    plots: Annotated[
        Path | None, Parameter(help="Write the spectrum and level figures into this directory.")
    ] = None,
    json: Json = False,
) -> None:
    """Show what a stranger's recording is, and which declaration of it is consistent."""
    from sdr import probe as prober

    _report("probe", prober.probe(file, recording, plots), json)


@app.command
def plot(
    results: Path,
    /,
    *,
    output: Annotated[
        Path | None, Parameter(name=["--output", "-o"], help="Directory for the figures.")
    ] = None,
    json: Json = False,
) -> None:
    """Draw the figures of a results file."""
    from sdr import plot as plotter

    figures = [str(p) for p in plotter.plot(results, output)]
    _report("plot", {"figures": figures, "text": "\n".join(figures)}, json)


@app.command
def export(
    results: Path,
    /,
    *,
    rinex_obs: Annotated[Path | None, Parameter(help="RINEX 3.05 observation file to write.")] = None,
    nmea: Annotated[Path | None, Parameter(help="NMEA 0183 file to write (GGA, RMC, GSA, VTG).")] = None,
    kml: Annotated[Path | None, Parameter(help="KML file to write.")] = None,
    gpx: Annotated[Path | None, Parameter(help="GPX file to write.")] = None,
    mat: Annotated[Path | None, Parameter(help="Directory for GNSS-SDR's tracking dumps (.mat).")] = None,
    csv: Annotated[Path | None, Parameter(help="Directory for one CSV per dataset.")] = None,
    json: Json = False,
) -> None:
    """Write a results file in the formats of others."""
    from sdr import export as exporter

    result = exporter.export(results, rinex_obs=rinex_obs, nmea=nmea, kml=kml, gpx=gpx, mat=mat, csv_dir=csv)
    _report("export", result, json)


@app.command
def lines(
    *,
    signal: Annotated[str | None, Parameter(help="L1CA, E1B or E1C; all if not given.")] = None,
    waveform: Annotated[
        str | None, Parameter(help="BPSK, BOC11, CBOC+ or CBOC-; all that fit if not given.")
    ] = None,
    prn: Annotated[int | None, Parameter(help="One PRN; all if not given.")] = None,
    top: Annotated[int, Parameter(help="Lines to list per signal and waveform, or for one PRN.")] = 5,
    tiered: Annotated[
        bool, Parameter(negative="", help="E1-C with its secondary code (100 ms period).")
    ] = False,
    plots: Annotated[Path | None, Parameter(help="Write the figures into this directory.")] = None,
    json: Json = False,
) -> None:
    """List the strongest code spectrum lines: where a CW jammer hurts most."""
    from sdr import lines as liner

    _report("lines", liner.lines(signal, waveform, prn, top, tiered, plots), json)


@app.command
def counterfactual(
    scenario: str,
    /,
    *,
    without: Annotated[
        list[str],
        Parameter(
            name="--without",
            negative="",
            consume_multiple=True,
            help="Factors to leave out: jammer multipath dynamics quantisation.",
        ),
    ],
    output: Annotated[
        Path | None, Parameter(name=["--output", "-o"], help="Directory for the figure.")
    ] = None,
    json: Json = False,
    set_: Set = [],  # noqa: B006
    threads: Threads = 1,
) -> None:
    """Replay a scenario's noise with and without its jammers, echoes, dynamics or quantisation: what each does."""
    from sdr import counterfactual as replay

    result = replay.counterfactual(
        scenario, without, output=output, overrides=set_, threads=threads, quiet=json
    )
    _report("counterfactual", result, json)


@app.command
def inject(
    file: Path,
    scenario: str,
    /,
    *,
    recording: Recording = Recording(),
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Recording to write (base name).")],
    plots: Annotated[bool, Parameter(negative="", help="Draw it before and after.")] = False,
    json: Json = False,
    set_: Set = [],  # noqa: B006
) -> None:
    """Add a scenario's jammers and echoes to a recording, at exact J/N, through gain control and quantiser."""
    from sdr import inject as injector

    result = injector.inject(file, recording, scenario, output, overrides=set_, plots=plots, quiet=json)
    _report("inject", result, json)


@app.command
def bench(
    *, json: Json = False, quick: Annotated[bool, Parameter(negative="", help="Shorter, noisier.")] = False
) -> None:
    """Measure the speed of this machine's receiver and generator, as ratios to a plain kernel in the same run."""
    from sdr import bench as bencher

    _report("bench", bencher.bench(quick=quick, quiet=json), json)


@app.command
def campaign(
    file: str,
    /,
    *,
    output: Out = None,
    workers: Annotated[
        int | None, Parameter(help="Local processes; the results do not depend on it.")
    ] = None,
    scheduler: Annotated[str | None, Parameter(help="Dask scheduler, e.g. tcp://127.0.0.1:8786.")] = None,
    confirm: Annotated[
        int | None, Parameter(help="Rerun this point on IF samples and say whether the two agree.")
    ] = None,
    plots: Annotated[bool, Parameter(negative="", help="Draw the figures beside the results.")] = False,
    json: Json = False,
    set_: Set = [],  # noqa: B006
) -> None:
    """Count missed detections and false alarms over a grid of settings; goes on where it was stopped.

    FILE is a TOML file or the name of a built-in campaign (see: gnssbb scenarios).
    """
    if confirm is not None:
        from sdr.campaign import confirm as confirmer

        _report("campaign", confirmer.confirm(file, confirm, overrides=set_, quiet=json), json)
        return
    from sdr.campaign import run as runner

    result = runner.run(
        file, output=output, workers=workers, scheduler=scheduler, overrides=set_, plots=plots, quiet=json
    )
    _report("campaign", result, json)


@app.command
def reproduce(
    name: str,
    /,
    *,
    output: Annotated[
        Path | None, Parameter(name=["--output", "-o"], help="Directory for figures and tables.")
    ] = None,
    quick: Annotated[bool, Parameter(negative="", help="Short runs, wide intervals.")] = False,
    seed: Annotated[int, Parameter(help="Root of all random numbers.")] = 1,
    json: Json = False,
) -> None:
    """Run a published experiment again and compare: figures, a table, and verdicts.

    NAME: ouzeau2008, abdelhafez-als, abdelhafez-bias, vanek1999, karaim2020, integrity-live, high-dynamics.
    """
    from sdr import reproduce as reproducer

    result = reproducer.reproduce(name, output, quick=quick, seed=seed)
    if json:
        print(jsonlib.dumps(result["items"], allow_nan=False))
    else:
        _report("reproduce", result, False)


@app.command
def scenarios(*, json: Json = False) -> None:
    """List the built-in scenarios and campaigns."""
    from sdr import toml

    result: dict[str, Any] = {}
    for kind in ("scenario", "campaign"):
        tables = {n: toml.table(toml.read(n, kind), n) for n in toml.built_in(kind)}
        result[f"{kind}s"] = [{"name": n, "description": t.get("description", "")} for n, t in tables.items()]
    lines = [f"{r['name']:24} {r['description']}" for r in result["scenarios"]]
    lines += ["", "campaigns:"] + [f"{r['name']:24} {r['description']}" for r in result["campaigns"]]
    _report("scenarios", result | {"text": "\n".join(lines)}, json)


def _report(command: str, result: dict[str, Any], as_json: bool) -> None:
    """Print a job's result: its ``text`` for people, everything else for machines."""
    text = result.pop("text", None)
    if as_json:
        head = {"command": command, "version": version(), "schema": SCHEMA_VERSION}
        print(jsonlib.dumps(head | result, allow_nan=False, default=_plain))
    else:
        print(text if text is not None else jsonlib.dumps(result, indent=2, default=_plain))


def _plain(value: Any) -> Any:
    """Numpy scalars and arrays, bytes and paths as JSON knows them."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, bytes):
        return value.decode()
    return str(value)


def main() -> None:
    """Entry point: run a command; bad input is one sentence and exit code 2, an interrupt is 130."""
    heard: list[int] = []

    def interrupt(number: int, frame: object) -> None:
        heard.append(number)
        raise KeyboardInterrupt

    # A shell's background jobs ignore SIGINT, and go on doing so.
    for number in (signal.SIGTERM, signal.SIGINT):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, interrupt)
    sys.unraisablehook = _interrupt_again
    try:
        app(exit_on_error=False, print_error=False)
    except (KeyboardInterrupt, Exception) as err:
        # Compiled code may answer an interrupt with an error of its own.
        if heard or isinstance(err, KeyboardInterrupt):
            print("gnssbb: interrupted", file=sys.stderr)
            sys.exit(130)
        _explain(err)


def _explain(err: Exception) -> None:
    """One sentence and exit code 2 for what is not this program's fault; anything else is raised again."""
    if isinstance(err, CycloptsError):
        _fail(" ".join(str(err).split()))
    if isinstance(err, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    if isinstance(err, MemoryError):
        _fail("not enough memory; use a shorter duration or a lower sample rate")
    if "GNSSBB_DEBUG" in os.environ or not isinstance(err, ValueError | OSError | ImportError):
        raise err
    _fail(str(err))


def _interrupt_again(dropped: "sys.UnraisableHookArgs") -> None:
    """Python drops an interrupt that falls into a destructor or a weak reference's callback: send it again."""
    if not issubclass(dropped.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(dropped)
        return
    threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()


def _fail(sentence: str) -> None:
    print(f"gnssbb: {sentence}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
