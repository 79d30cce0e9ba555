"""The seven stages, one folder each; a stage never imports another.

Datasets are named as addresses (``sparkfun.ground_truth.bias``), nodes are grouped by stage. Kedro
reserves dots for namespaces and warns of every such name; here they are meant.
"""

import warnings

warnings.filterwarnings("ignore", message="One or more dataset names contain '.'")
