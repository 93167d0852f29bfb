"""Names of objects, in any script."""

from unicodedata import normalize

import msgspec
import pytest

from catstream.base.names import boxes_by_name, by_name, check_name, split_name
from catstream.errors import ObjectError
from catstream.wire.schema import ObjectName

NAMES = ["anna-2", "हिन्दी", "ราตรี", "مُحَمَّد", "שָׁלוֹם", "ខ្មែរ", "Việt", "نمی\u200cخواهم", "𑄇𑄧", "犬", "İ", "ß9"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_of_all_scripts_are_valid_and_stored_composed(name, form):
    composed = check_name(normalize(form, name))
    assert composed == normalize("NFC", name)
    assert msgspec.convert(composed, ObjectName) == composed
    assert split_name(f"{normalize(form, name)}=1,2,3,4") == (composed, "1,2,3,4")
    assert [*boxes_by_name({normalize(form, name): "1,2,3,4"})] == [composed]


@pytest.mark.parametrize(
    "name", ["a b", "a/b", "a+b", "#", "a,b", 'a"', "-a", ".a", "\u0301a", "a\u202eb", "a\n", "x" * 65, 3]
)
def test_name_that_is_unsafe_in_addresses_or_files_is_an_error(name):
    with pytest.raises(ObjectError, match="is not a name"):
        check_name(name)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(name, ObjectName)


def test_two_spellings_of_one_name_are_an_error():
    with pytest.raises(ObjectError, match="two objects have one name"):
        by_name({"Zoë": 1, "ben": 2, "Zoe\u0308": 3})
