"""Validation errors of nested configurations."""

from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, PositiveInt, ValidationError, field_validator

from crossgrad_core.registry.validation import as_user_error


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid")

    size: int = 1


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid")

    inner: Inner = Inner()
    color: str = "black"

    @field_validator("color")
    @classmethod
    def _known(cls, value):
        if value != "black":
            raise ValueError("must be black")
        return value


class Empty(BaseModel):
    model_config = ConfigDict(extra="forbid")


def explained(model, values):
    with pytest.raises(ValidationError) as caught:
        model.model_validate(values)
    return as_user_error(caught.value, model, subject="a run", todo="read the help")


def test_an_unknown_nested_key_suggests_the_keys_at_its_position():
    error = explained(Outer, {"inner": {"sise": 2}})
    assert error.where == "inner.sise"
    assert error.expected == "one of size"
    assert error.todo == "did you mean 'size'?; read the help"


def test_an_unknown_option_of_a_model_without_options_is_reported_so():
    assert explained(Empty, {"a": 1}).expected == "no options: it has none"


def test_the_message_of_a_validator_is_kept():
    error = explained(Outer, {"color": "red"})
    assert error.expected == "must be black"
    assert error.found == "'red' (str)"


def test_a_value_in_place_of_a_settings_group_is_reported_with_its_type():
    error = explained(Outer, {"inner": 3})
    assert error.where == "inner"
    assert error.found == "3 (int)"


def test_an_error_of_the_whole_configuration_names_the_configuration():
    assert explained(Outer, "text").what == "a run is not valid"


@pytest.mark.parametrize("values", [{"": 3}, 3])
def test_a_validation_error_without_a_field_name_has_a_location(values):
    assert explained(Outer, values).where == "a run"


class Unions(BaseModel):
    model_config = ConfigDict(extra="forbid")

    count: Annotated[PositiveInt | Literal["auto"] | None, "help"] = None
    up: Literal["auto"] | tuple[float, float, float] = "auto"
    parts: list[Inner | Outer] = []
    inner: Inner | None = None


def test_a_value_that_fits_no_type_of_a_union_is_reported_once_with_all_types():
    error = explained(Unions, {"count": 0})
    assert error.where == "count"
    assert error.what == "option count of a run is not valid"
    assert error.expected == "greater than 0, or 'auto'"
    assert error.todo == "read the help"


def test_the_path_of_an_error_inside_a_union_omits_the_union_type():
    error = explained(Unions, {"up": (0, "x", 0), "count": "many"})
    assert error.where == "count"
    assert error.todo == "also wrong: up, up.1; read the help"


def test_an_unknown_key_inside_a_union_suggests_the_keys_of_its_type():
    error = explained(Unions, {"parts": [{"inner": {"sise": 1}}]})
    assert error.where == "parts.0.inner"
    assert error.expected == "one of size"
    assert explained(Unions, {"inner": {"sise": 1}}).todo == "did you mean 'size'?; read the help"
