"""Contract checks for the components of every slot."""

from pydantic import ValidationError

from crossgrad_core.contract.component import Component
from crossgrad_core.errors import UserError
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.testing.support.contract import Check, ContractError, Make, require
from crossgrad_core.wording import in_one_line, listed, sentences


def options_are_frozen(make: Make[Component]) -> None:
    """Options cannot change after construction, and the component is hashable."""
    component = make()
    require(component.model_config.get("frozen"), "the model is not frozen: keep `frozen=True`")
    try:
        hash(component)
    except TypeError as error:
        raise ContractError(
            f"the component cannot be hashed ({error}): use tuples and frozen values as options"
        ) from error


def unknown_options_are_refused(make: Make[Component]) -> None:
    """An option with a misspelt name raises an error."""
    component = make()
    surprise = {**component.model_dump(), "no_such_option_": 1}
    try:
        type(component).model_validate(surprise)
    except ValidationError:
        return
    raise ContractError("the component accepts an unknown option: keep `extra='forbid'`")


def options_survive_the_configuration_file(make: Make[Component]) -> None:
    """Options that are written to config.yaml and read again are equal to the original options."""
    component = make()
    try:
        again = type(component).model_validate(component.model_dump(mode="json"))
    except ValidationError as error:
        raise ContractError(
            f"options that were written cannot be read back: {in_one_line(error)}"
        ) from error
    require(again == component, f"the options {component!r} are read back as {again!r}")


def options_are_described(make: Make[Component]) -> None:
    """Each option has a description, which `crossgrad plugins show` prints."""
    fields = type(make()).model_fields
    silent = [name for name, field in fields.items() if not field.description]
    require(
        not silent, f"options without a description: {listed(silent)}; use Field(description=...)"
    )


def options_can_be_set(make: Make[Component]) -> None:
    """No option has the name `name`, because this key chooses the component."""
    clear = "name" not in type(make()).model_fields
    require(
        clear, "the option `name` cannot be set, because this key chooses the component: rename it"
    )


def hooks_exist(make: Make[Component]) -> None:
    """Each hook of the component exists, is marked with `hookimpl`, and has valid arguments."""
    try:
        make_manager({"component": make()})
    except UserError as error:
        raise ContractError(f"{error.what}: {sentences(error.found, error.todo)}") from error


COMPONENT_CHECKS: tuple[Check[Component], ...] = (
    options_are_frozen,
    unknown_options_are_refused,
    options_survive_the_configuration_file,
    options_are_described,
    options_can_be_set,
    hooks_exist,
)
