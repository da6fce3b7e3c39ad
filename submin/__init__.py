"""submin: ground-control networks for a continent, with the covariance between any of their points."""

from submin.query.control_set import ControlSet
from submin.storage.network import Network
from submin.storage.network import open_network as open

__all__ = ["ControlSet", "Network", "open"]
