"""Runs the nodes whose inputs, settings or code changed, and says which are left as they are.

The fingerprint of a node is a hash of the package's code, of its parameters and of its inputs: of
an input that a node makes, the fingerprint of that node; of any other, the state of the dataset,
which is the digest of a stored file (:mod:`gyro_pipeline.datasets.stored`).
A node that ends leaves its fingerprint in a file. It is run again if that is another one, or if
what it stored is not there or was changed since.
"""

import json
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from kedro.framework.hooks import hook_impl
from kedro.io import CatalogProtocol, MemoryDataset
from kedro.pipeline import Node, Pipeline
from kedro.runner import SequentialRunner
from pluggy import PluginManager

from gyro_pipeline.conventions import ALWAYS
from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.datasets.stored import digest_of
from gyro_pipeline.estimators import own_classes
from gyro_pipeline.fingerprints import code_hash, fingerprint

logger = logging.getLogger(__name__)

_PARAMETERS = "params:"


class ChangedNodesRunner(SequentialRunner):
    """Leaves out the nodes whose results are those of their inputs, settings and code already.

    Args:
        ended: A JSON file with the fingerprints of nodes that ended.
    """

    def __init__(self, ended: Path) -> None:
        super().__init__()
        self._path, self._ended = ended, _read(ended)
        self._fingerprints: dict[str, str] = {}
        self._catalog: Any = None
        self._storing: Node | None = None

    def run(
        self,
        pipeline: Pipeline,
        catalog: Any,
        hook_manager: PluginManager | None = None,
        run_id: str | None = None,
        only_missing_outputs: bool = False,
    ) -> dict[str, Any]:
        """Run what changed; see :class:`kedro.runner.AbstractRunner`."""
        self._catalog, self._fingerprints = catalog, _fingerprints(pipeline, catalog)
        nodes = self._to_run(pipeline)
        left = [node for node in pipeline.nodes if node not in nodes]
        if left:
            stages = ", ".join(dict.fromkeys(str(node.namespace) for node in left))
            logger.info(
                "%d of %d nodes are up to date and not run again (%s)",
                *(len(left), len(pipeline.nodes), stages),
            )
        if not nodes:
            return {}
        if hook_manager is not None:
            hook_manager.register(self)
        made = super().run(Pipeline(nodes), catalog, hook_manager, run_id, only_missing_outputs)
        for node in pipeline.nodes:  # what a later node adds to a store is no change of it
            self._remember(node)
        return made

    @hook_impl
    def after_node_run(self, node: Node) -> None:
        """Note a node whose results are stored next: those of a generator as it makes them."""
        self._storing = node

    @hook_impl
    def before_node_run(self) -> None:
        """Remember the node before, which has ended, whatever becomes of the rest of the run."""
        if self._storing is not None:
            self._remember(self._storing)
        self._storing = None

    def _remember(self, node: Node) -> None:
        content = [self._fingerprints[node.name], _states(node, self._catalog)]
        if self._ended.get(_key(node, self._catalog)) != content:
            self._ended[_key(node, self._catalog)] = content
            with replacing(self._path) as temporary:
                temporary.write_text(json.dumps(self._ended, indent=0, sort_keys=True))

    def _to_run(self, pipeline: Pipeline) -> list[Node]:
        """Nodes that changed, and those that make again what is kept in memory for them."""
        wanted: set[str] = set()
        nodes = []
        for node in reversed(pipeline.nodes):
            if self._changed(node) or wanted & set(node.outputs):
                nodes.append(node)
                wanted |= {name for name in node.inputs if _in_memory(name, self._catalog)}
        return nodes[::-1]

    def _changed(self, node: Node) -> bool:
        kept = [name for name in node.outputs if not _in_memory(name, self._catalog)]
        if ALWAYS in node.tags:
            return True
        if node.outputs and not kept:
            return False  # it is run where another node needs what it makes
        before, states = self._ended.get(_key(node, self._catalog)), _states(node, self._catalog)
        if before is not None and before[0] == self._fingerprints[node.name]:
            for name, earlier, now in zip(kept, before[1], states, strict=True):
                if isinstance(earlier, str) and now != earlier:  # a file: run stores grow
                    logger.warning("%s: missing, damaged or changed, so it is made again", name)
        there = all(map(self._catalog.exists, kept))
        return not there or before != [self._fingerprints[node.name], states]


def _fingerprints(pipeline: Pipeline, catalog: CatalogProtocol) -> dict[str, str]:
    """The fingerprint of each node by its name."""
    makers = {name: node.name for node in pipeline.nodes for name in node.outputs}
    states = {name: _state(name, catalog) for name in pipeline.inputs()}
    made: dict[str, str] = {}
    for node in pipeline.nodes:
        inputs = {
            name: made[makers[name]] if name in makers else states[name] for name in node.inputs
        }
        texts = json.dumps(inputs, sort_keys=True, default=str)
        code = code_hash("gyro_pipeline", *_own_classes(inputs.values()))
        made[node.name] = fingerprint([node.name, node.func.__name__, code, texts])
    return made


def _own_classes(inputs: Iterable[Any]) -> list[str]:
    """Estimators of one's own, ``package.module:Class``, in studies: their code counts as well."""
    given = [value.get("estimators") for value in inputs if isinstance(value, Mapping)]
    return own_classes(name for names in given if isinstance(names, list) for name in names)


def _state(name: str, catalog: CatalogProtocol) -> Any:
    """What tells that the content of a dataset changed: its parameters, its own word, its file."""
    if name.startswith(_PARAMETERS) or name == "parameters":
        return catalog.load(name)
    dataset: Any = catalog.get(name)
    if hasattr(dataset, "state"):
        return dataset.state()
    path = Path(dataset._describe().get("filepath", ""))
    return digest_of(path) if path.is_file() else None


def _states(node: Node, catalog: CatalogProtocol) -> list[Any]:
    return [_state(name, catalog) for name in node.outputs if not _in_memory(name, catalog)]


def _in_memory(name: str, catalog: CatalogProtocol) -> bool:
    """Whether a dataset holds what another node makes only until it was used."""
    dataset = catalog.get(name)
    passing = isinstance(dataset, MemoryDataset) or getattr(dataset, "used_up", False)
    return passing or name.startswith(_PARAMETERS)


def _key(node: Node, catalog: Any) -> str:
    """The node and where it stores: environments have the same nodes."""
    paths = [str(catalog.get(name)._describe()) for name in node.outputs]
    return f"{node.name} {fingerprint(paths)}"


def _read(path: Path) -> dict[str, Any]:
    """What nodes left; of a file that cannot be read nothing, so that all of them are run."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
