"""Cases of bad input, each entered in ``CASES`` by the module that is about its kind."""

# Cases are tried in the order they are entered, whichever module is imported first: it is not that of the alphabet.
# isort: off
from bad_input.world import CASES
from bad_input import network_cases, catalogue_cases, block_cases, query_cases, control_cases, adjusting_cases, import_cases

__all__ = ["CASES", "adjusting_cases", "block_cases", "catalogue_cases", "control_cases", "import_cases", "network_cases", "query_cases"]
