"""Which modules of `cosmos_cli.fleet.onboard` work on a machine for `cosmos up`: quick to import, unlike their users."""

STORE_PARTS = ("store", "installed", "keep", "trees", "wheels", "environment")
"""For trees and environments."""
HELPER_PARTS = ("files", "links", "facts", *STORE_PARTS, "system", "apt_words", "apt")
"""Each is loaded there when it is first needed."""
