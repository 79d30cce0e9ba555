"""A runner that runs only the nodes whose inputs, settings or code changed.

The fingerprint of a node is a hash of the package's code, the node's parameters and its inputs. An
input counts with the fingerprint of the node that computes it, any other with the state of its
dataset, which for a stored file is its digest (:mod:`gyro_pipeline.datasets.stored`). The
fingerprints of completed nodes are stored in a file. A node runs again if its fingerprint changed,
or if its stored outputs are missing or were changed.
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
    """Leaves out the nodes whose stored results are up to date.

    Args:
        path: A JSON file with the fingerprints of completed nodes.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._completed = path, _read(path)
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
        """Run the changed nodes; see :class:`kedro.runner.AbstractRunner`."""
        self._catalog, self._fingerprints = catalog, _fingerprints(pipeline, catalog)
        nodes = self._nodes_to_run(pipeline)
        current = [node for node in pipeline.nodes if node not in nodes]
        if current:
            stages = ", ".join(dict.fromkeys(str(node.namespace) for node in current))
            logger.info(
                "%d of %d nodes are up to date and not run again (%s)",
                *(len(current), len(pipeline.nodes), stages),
            )
        if not nodes:
            return {}
        if hook_manager is not None:
            hook_manager.register(self)
        outputs = super().run(Pipeline(nodes), catalog, hook_manager, run_id, only_missing_outputs)
        for node in pipeline.nodes:  # again, since a later node may have added to the same store
            self._remember(node)
        return outputs

    @hook_impl
    def after_node_run(self, node: Node) -> None:
        """Keep the node whose results are stored next; those of a generator are still to come."""
        self._storing = node

    @hook_impl
    def before_node_run(self) -> None:
        """Remember the previous node as completed, even if the rest of the run fails."""
        if self._storing is not None:
            self._remember(self._storing)
        self._storing = None

    def _remember(self, node: Node) -> None:
        content = [self._fingerprints[node.name], _states(node, self._catalog)]
        if self._completed.get(_key(node, self._catalog)) != content:
            self._completed[_key(node, self._catalog)] = content
            with replacing(self._path) as temporary:
                temporary.write_text(json.dumps(self._completed, indent=0, sort_keys=True))

    def _nodes_to_run(self, pipeline: Pipeline) -> list[Node]:
        """Nodes that changed, and nodes that compute inputs of these which are not stored."""
        missing: set[str] = set()
        nodes = []
        for node in reversed(pipeline.nodes):
            if self._changed(node) or missing & set(node.outputs):
                nodes.append(node)
                missing |= {name for name in node.inputs if _in_memory(name, self._catalog)}
        return nodes[::-1]

    def _changed(self, node: Node) -> bool:
        stored = [name for name in node.outputs if not _in_memory(name, self._catalog)]
        if ALWAYS in node.tags:
            return True
        if node.outputs and not stored:
            return False  # it runs if another node needs its outputs
        before, states = (
            self._completed.get(_key(node, self._catalog)),
            _states(node, self._catalog),
        )
        if before is not None and before[0] == self._fingerprints[node.name]:
            for name, earlier, now in zip(stored, before[1], states, strict=True):
                if isinstance(earlier, str) and now != earlier:  # a file; run stores grow
                    logger.warning("%s: missing, damaged or changed, so it is made again", name)
        complete = all(map(self._catalog.exists, stored))
        return not complete or before != [self._fingerprints[node.name], states]


def _fingerprints(pipeline: Pipeline, catalog: CatalogProtocol) -> dict[str, str]:
    """The fingerprint of each node, by the node's name."""
    states = {name: _state(name, catalog) for name in pipeline.inputs()}
    fingerprints: dict[str, str] = {}
    for node in pipeline.nodes:
        inputs = {name: states[name] for name in node.inputs}
        texts = json.dumps(inputs, sort_keys=True, default=str)
        code = code_hash("gyro_pipeline", *_own_classes(inputs.values()))
        digest = fingerprint([node.name, node.func.__name__, code, texts])
        fingerprints[node.name] = digest
        states |= dict.fromkeys(node.outputs, digest)
    return fingerprints


def _own_classes(inputs: Iterable[Any]) -> list[str]:
    """The user's estimators, ``package.module:Class``, in studies: their code counts as well."""
    lists = [value.get("estimators") for value in inputs if isinstance(value, Mapping)]
    return own_classes(name for names in lists if isinstance(names, list) for name in names)


def _state(name: str, catalog: CatalogProtocol) -> Any:
    """A value that changes with the content of a dataset: parameters, a state, or a digest."""
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
    """Whether a dataset holds the output of a node only until other nodes have used it."""
    dataset = catalog.get(name)
    temporary = isinstance(dataset, MemoryDataset) or getattr(dataset, "used_up", False)
    return temporary or name.startswith(_PARAMETERS)


def _key(node: Node, catalog: Any) -> str:
    """The node and the paths of its outputs, since environments have the same nodes."""
    paths = [str(catalog.get(name)._describe()) for name in node.outputs]
    return f"{node.name} {fingerprint(paths)}"


def _read(path: Path) -> dict[str, Any]:
    """Stored fingerprints; empty if the file cannot be read, so that all nodes run."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
