"""The seven stages, a folder for each; a stage never imports another one.

Names of datasets have the form ``sparkfun.ground_truth.bias``, and nodes are grouped by stage.
Kedro reserves dots for namespaces and warns of every such name; here they are intended.
"""

import warnings

warnings.filterwarnings("ignore", message="One or more dataset names contain '.'")
