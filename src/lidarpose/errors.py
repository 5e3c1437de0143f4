"""The errors that users meet. The command line turns each into one message and an exit status.

Every message says what is wrong, where, what was expected, and how to mend it.
"""

from __future__ import annotations

from os import PathLike, fspath


class LidarposeError(Exception):
    """Base of all errors that lidarpose raises on purpose."""


class InputError(LidarposeError):
    """Input that cannot be read or used as it is (exit status 2).

    Parameters
    ----------
    where
        The file (or option) at fault.
    problem
        What is wrong and what was found.
    field
        The key, column, line or header field at fault, where there is one.
    expected
        What should have been there.
    remedy
        What the user can do about it.
    """

    def __init__(
        self,
        where: str | PathLike[str],
        problem: str,
        *,
        field: str | None = None,
        expected: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.where = fspath(where)
        self.problem = problem
        self.field = field
        self.expected = expected
        self.remedy = remedy
        place = f"{self.where}: {field}" if field else self.where
        text = f"{place}: {problem}"
        if expected:
            text += f"; expected {expected}"
        if remedy:
            text += f". {remedy}"
        super().__init__(text)

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_input_error, (self.where, self.problem, self.field, self.expected, self.remedy)


def _rebuild_input_error(
    where: str, problem: str, field: str | None, expected: str | None, remedy: str | None
) -> InputError:
    return InputError(where, problem, field=field, expected=expected, remedy=remedy)


class UndeterminedError(LidarposeError):
    """Readable data that do not determine what was asked (exit status 1).

    Parameters
    ----------
    what
        The motion or quantity that stays undetermined, and why.
    remedy
        What to record, or to say on the command line, to determine it.
    details
        Further lines, such as the places that were left out with their reasons.
    """

    def __init__(self, what: str, *, remedy: str, details: tuple[str, ...] = ()) -> None:
        self.what = what
        self.remedy = remedy
        self.details = details
        super().__init__("\n  ".join([f"{what}. {remedy}", *details]))

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_undetermined_error, (self.what, self.remedy, self.details)


def _rebuild_undetermined_error(what: str, remedy: str, details: tuple[str, ...]) -> UndeterminedError:
    return UndeterminedError(what, remedy=remedy, details=details)


class AmbiguousError(UndeterminedError):
    """Two solutions explain the data, and nothing tells which is right (exit status 1).

    Parameters
    ----------
    misfit_sigmas
        Root mean square residual of the better one in stated sigmas: if that is small, nothing is wrong with the data.
    """

    def __init__(self, what: str, *, remedy: str, misfit_sigmas: float) -> None:
        super().__init__(what, remedy=remedy)
        self.misfit_sigmas = misfit_sigmas

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_ambiguous_error, (self.what, self.remedy, self.misfit_sigmas)


def _rebuild_ambiguous_error(what: str, remedy: str, misfit_sigmas: float) -> AmbiguousError:
    return AmbiguousError(what, remedy=remedy, misfit_sigmas=misfit_sigmas)


class RejectedError(UndeterminedError):
    """An estimate was made, and its own tests say that it must not be used (exit status 1).

    Parameters
    ----------
    what
        What is rejected.
    reasons
        Each with what to do about it.
    """

    def __init__(self, what: str, *, reasons: tuple[str, ...]) -> None:
        first = reasons[0] if reasons else "see the report"
        super().__init__(what, remedy=f"Do not use it: {first}", details=reasons[1:])
        self.reasons = reasons

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild_rejected_error, (self.what, self.reasons)


def _rebuild_rejected_error(what: str, reasons: tuple[str, ...]) -> RejectedError:
    return RejectedError(what, reasons=reasons)
