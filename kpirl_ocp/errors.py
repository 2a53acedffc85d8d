"""The exceptions of the toolkit: one small tree, every message says what was wrong and what to do."""


class KpirlError(Exception):
    """Base of every error this package raises on purpose."""


class RobotError(KpirlError, ValueError):
    """A robot description cannot be used: unreadable file, unknown link or joint type."""


class ProblemError(KpirlError, ValueError):
    """An optimal-control problem is inconsistent, or does not fit the solver or method it was given to."""


class EpisodeError(KpirlError, ValueError):
    """An episode on disk is missing, malformed or not finite; the message names file and key."""


class ModelError(KpirlError, ValueError):
    """A network on disk is missing, malformed or of an unsupported kind; the message names file and key."""


class SolveError(KpirlError, RuntimeError):
    """A solve failed and the caller asked for an exception (`Solution.raise_if_failed`)."""


class CertificateError(KpirlError, RuntimeError):
    """A gradient could not be certified under the policy "raise".

    Attributes:
        certificate: the failed certificate, with every quantity that was measured.
    """

    def __init__(self, message: str, certificate: object) -> None:
        super().__init__(message)
        self.certificate = certificate
