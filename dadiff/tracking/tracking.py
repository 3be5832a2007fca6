"""The component that results are tracked with: an MLflow store that mirrors an output folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dadiff.errors import ConfigError
from dadiff.outside import without_passwords
from dadiff.store import StoredRun, Sweep, Sweeps, store_id
from dadiff.store.files import make_folder
from dadiff.tracking.client import open_client, prepare_store, spared
from dadiff.tracking.content import Piece, run_piece, sweep_piece, training_piece
from dadiff.tracking.database import damage_of
from dadiff.tracking.links import LOCAL_UI, Held, held
from dadiff.tracking.mirror import opened
from dadiff.tracking.models import log_models
from dadiff.tracking.places import SQLITE, interface_of
from dadiff.tracking.views import STATE, short_names, sweep_view, table_page

if TYPE_CHECKING:
    from mlflow import MlflowClient


@dataclass(frozen=True)
class Tracking:
    """Mirrors what lies on disk into MLflow. With `enabled=False` every method does nothing.

    Args:
        uri: the store: sqlite:///path, postgresql://..., or a server http://....
        experiment: the MLflow experiment that everything goes into.
        artifacts: folder of the artifacts; a server has its own.

    Raises:
        ConfigError: if the uri is of no known kind.
    """

    uri: str
    experiment: str = "dadiff"
    artifacts: str | None = None
    enabled: bool = True

    def __post_init__(self) -> None:
        if not self.uri.startswith((SQLITE, "postgresql", "mysql", "http://", "https://")):
            raise ConfigError(f"tracking: uri is {self.uri!r}; expected sqlite:///path, postgresql://... or http://...")
        if self.uri.startswith(SQLITE):
            object.__setattr__(self, "uri", SQLITE + str(Path(self.uri.removeprefix(SQLITE)).absolute()))
        if self.artifacts is not None:
            object.__setattr__(self, "artifacts", str(Path(self.artifacts).absolute()))

    @classmethod
    def of(cls, config: Mapping[str, Any], output_dir: Path | str, uri: str | None = None) -> Tracking:
        """That of a stored configuration, whose output folder may have been moved since.

        Args:
            output_dir: where the output folder lies now.
            uri: of another store to use in its place.
        """
        here, known = str(Path(output_dir).absolute()), {field.name for field in fields(cls)}
        given = {name: value for name, value in config.get("tracking", {}).items() if name in known}
        given = {"uri": f"{SQLITE}{here}/mlflow.db", "artifacts": f"{here}/mlartifacts"} | given
        before = str(config.get("output_dir", here))
        given = {k: v.replace(f"{before}/", f"{here}/") if isinstance(v, str) else v for k, v in given.items()}
        if uri is not None and uri.startswith(SQLITE):
            given["artifacts"] = str(Path(uri.removeprefix(SQLITE)).absolute().parent / "mlartifacts")
        return cls(**given | ({} if uri is None else {"uri": uri}))

    def look(self) -> None:
        """Refuse a store before anything runs; one that is a file is looked at without MLflow, and made by `prepare`.

        Raises:
            StoreError: if a server is away, or a file is no database of MLflow's or cannot be written.
        """
        path = Path(self.uri.removeprefix(SQLITE))
        if not self.uri.startswith(SQLITE):
            self.prepare()
        elif self.enabled and make_folder(path.parent) and path.is_file():
            damage_of(path, self.experiment, self.artifacts)

    def prepare(self) -> None:
        """Make the store and the experiment.

        Raises:
            StoreError: if a server is away or a database cannot be opened.
        """
        if self.enabled:
            _ = self._experiment_id

    def log_run(self, run: StoredRun, parent: str | None = None, name: str | None = None) -> None:
        """Mirror a stored run.

        Args:
            parent: the MLflow run of its sweep.
            name: what its sweep calls it; None for its own name.
        """
        self._log(run.folder.parent.parent, run_piece(run, name), parent)

    def log_training(self, output_dir: Path | str, key: str) -> None:
        """Mirror a cached training as an MLflow run of its own, if it is in the cache."""
        piece = training_piece(output_dir, key)
        if piece is not None:
            self._log(output_dir, piece)

    def log_sweep(self, output_dir: Path | str, name: str) -> str | None:
        """Mirror a stored sweep. Returns the MLflow run that the sweep's runs are nested under, always the same one."""
        run_id = self._log(output_dir, sweep_piece(output_dir, name))
        if run_id is not None:
            with spared(f"the view of {name}"):
                self._show(Sweeps(output_dir).read(name), run_id)
        return run_id

    def catch_up(self, output_dir: Path | str, runs: Sequence[StoredRun], sweeps: Iterable[str] = ()) -> int:
        """Mirror runs, the trainings that they were made with, and sweeps, where they are missing. Returns how many.

        Raises:
            StoreError: if the store is away.
        """
        if not self.enabled:
            return 0
        brought, parents, named, ids = 0, dict[str, str](), dict[str, str](), dict[str, str]()
        with opened(self._client, self._experiment_id, output_dir) as mirror:
            for name in sweeps:
                run_id, missed = mirror.bring(sweep_piece(output_dir, name))
                sweep = Sweeps(output_dir).read(name)
                self._show(sweep, run_id)
                parents = {cell.key: run_id for cell in sweep.cells} | parents
                named = short_names(sweep) | named
                brought += missed
            for piece in filter(None, (training_piece(output_dir, key) for key in _trainings(runs))):
                brought += mirror.bring(piece)[1]
            for run in runs:
                ids[run.key], missed = mirror.bring(run_piece(run, named.get(run.key)), parents.get(run.key))
                brought += missed
            mirror.tidy()
            log_models(self._client, self._experiment_id, runs, ids)
        return brought

    def mirrors(self, output_dir: Path | str, runs: Sequence[StoredRun], sweep: str | None = None) -> bool:
        """Whether the store has all of it as it lies on disk; no more than a guess, False, of one that is no file.

        Args:
            sweep: that the runs are nested under.
        """
        if not self.enabled:
            return True
        found, store = self._held(), store_id(output_dir)
        if found is None:
            return False
        parent = None
        if sweep is not None:
            parent = found.whole(store, sweep_piece(output_dir, sweep))
            if parent is None or _view(sweep) not in found.views:
                return False
        trainings = filter(None, (training_piece(output_dir, key) for key in _trainings(runs)))
        return all(found.whole(store, piece) for piece in trainings) and all(
            found.whole(store, run_piece(run), parent) for run in runs
        )

    def _held(self) -> Held | None:
        """What the store holds, if it is a file, and whole."""
        path = Path(self.uri.removeprefix(SQLITE))
        if not self.uri.startswith(SQLITE) or not path.is_file() or damage_of(path, self.experiment, self.artifacts):
            return None
        return held(path, self.experiment)

    def how_to_look(self, sweep_name: str) -> str:
        """What a person types and opens to see a sweep in MLflow's pages, with its axes and metrics as columns."""
        if not self.enabled:
            return "tracking is off"
        found = self._held()
        experiment_id = self._experiment_id if found is None else found.experiment_id
        page = table_page(experiment_id, sweep_name)
        if self.uri.startswith("http"):
            return f"open {without_passwords(self.uri)}{page}"
        return f"{interface_of(self.uri)}   then open {LOCAL_UI}{page}"

    @cached_property
    def _experiment_id(self) -> str:
        return prepare_store(self.uri, self.experiment, self.artifacts)

    @cached_property
    def _client(self) -> MlflowClient:
        return open_client(self.uri)

    def _log(self, output_dir: Path | str, piece: Piece, parent: str | None = None) -> str | None:
        """Mirror one piece; a store that is away is a warning. Returns the id of its MLflow run."""
        if self.enabled:
            with spared(piece.name), opened(self._client, self._experiment_id, output_dir, piece) as mirror:
                return mirror.bring(piece, parent)[0]
        return None

    def _show(self, sweep: Sweep, run_id: str) -> None:
        view = sweep_view(sweep, run_id)
        self._client.set_experiment_tag(self._experiment_id, _view(sweep.name), view)


def _trainings(runs: Iterable[StoredRun]) -> list[str]:
    """Keys of what runs were made with."""
    return list(dict.fromkeys(run.record.links["denoiser"] for run in runs if "denoiser" in run.record.links))


def _view(sweep_name: str) -> str:
    """The experiment's tag that holds the state of the page that shows a sweep."""
    return f"{STATE}{sweep_name}"
