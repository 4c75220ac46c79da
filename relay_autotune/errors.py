"""The errors that this package raises; each message says found, expected and what to do."""


class RelayAutotuneError(Exception):
    """Base of every error that the package raises on purpose."""


class ModelError(RelayAutotuneError, ValueError):
    """A transfer function that cannot be, or cannot do what was asked of it."""


class RecordError(RelayAutotuneError, ValueError):
    """Recorded data that contradict themselves or hold too little."""


class ParameterError(RelayAutotuneError, ValueError):
    """A parameter out of its range, or two that contradict each other."""


class IdentificationError(RelayAutotuneError, ValueError):
    """A record from which the method cannot tell a model."""


class TuningError(RelayAutotuneError, ValueError):
    """A rule that does not apply to the model."""


class BagError(RelayAutotuneError, ValueError):
    """A recording that cannot be read or written."""


class SelectionError(BagError):
    """A choice of topics or columns that a recording does not offer, or offers twice."""


class MissingPackageError(RelayAutotuneError, ImportError):
    """A Python package that is needed for this alone and is not installed."""


class LoopError(RelayAutotuneError, RuntimeError):
    """The nodes of a running loop are not there, or do not answer."""
