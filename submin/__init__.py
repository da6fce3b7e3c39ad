"""submin: ground-control networks for a continent, with the covariance between any of their points."""

from submin.query.control_set import ControlSet
from submin.storage.compact_table import CompactControl, read_compact
from submin.storage.control_files import read_control
from submin.storage.network import Network
from submin.storage.network import open_network as open

__all__ = ["CompactControl", "ControlSet", "Network", "open", "read_compact", "read_control"]
