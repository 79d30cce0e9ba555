"""The seven stages, a folder for each; a stage never imports another one.

In the order of the data: raw_logs, ground_truth, virtual_gyros, windowed_splits, training,
evaluation, reporting.

Names of datasets have the form ``sparkfun.ground_truth.bias``, and nodes are grouped by stage.
Kedro reserves dots for namespaces and warns of every such name; here they are intended.
"""

import warnings

warnings.filterwarnings("ignore", message="One or more dataset names contain '.'")
