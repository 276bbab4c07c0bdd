"""PredMapNet: online vectorised HD-map construction with future and historical reasoning (WACV 2026)."""

__version__ = "0.1.0"
