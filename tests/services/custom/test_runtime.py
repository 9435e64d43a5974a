"""The runtimes of Python, C++ and Lua behave alike."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest

from rse_pf.errors import (
    BadRequest,
    ConfigurationError,
    DegenerateGeometry,
    InternalError,
    RsePfError,
)
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import read_service
from rse_pf.services.custom.runtime import open_runtime

PYTHON = """
from __future__ import annotations
import msgspec
from rse_pf.errors import DegenerateGeometry
from rse_pf.wire.arrays import Array

class Request(msgspec.Struct):
    values: Array
    label: str = ""

class Reply(msgspec.Struct):
    total: float
    count: int
    label: str

class Service:
    def __init__(self):
        self.count = 0
    def serve(self, request: Request) -> Reply:
        if request.values.sum() < 0:
            raise DegenerateGeometry("negative")
        self.count += 1
        return Reply(total=request.values.sum(), count=self.count, label=request.label)
    def snapshot(self):
        return str(self.count).encode()
    def restore(self, data):
        self.count = int(data)
"""
LUA = """
local json, zlib = require "json", require "zlib"
local count = 0
return {
  serve = function(request)
    if type(request.values) ~= "table" then error({code = "bad-request", message = "values"}) end
    local total = 0
    for _, value in ipairs(request.values) do total = total + value end
    if total < 0 then error({code = "degenerate", message = "negative"}) end
    if request.label == "oops" then local nothing = nil; return nothing.x end
    if request.label == "zlib" then
      local binary = "\\0\\255h"
      assert(zlib.inflate(zlib.deflate(binary)) == binary)
    end
    count = count + 1
    return {total = total, count = count, label = json.decode(json.encode({request.label or ""}))[1]}
  end,
  snapshot = function() return {count = count} end,
  restore = function(state) count = state.count end,
}
"""
CPP = """
#include "rse_pf_service.hpp"
struct Adder {
  int count = 0;
  rse_pf::Fields call(const rse_pf::Fields &request) {
    double total = 0;
    for (double value : request.at("values").values) total += value;
    if (total < 0) throw rse_pf::Degenerate("negative");
    ++count;
    rse_pf::Fields reply;
    reply["total"] = rse_pf::Field::number(total);
    reply["count"] = rse_pf::Field::number(count);
    reply["label"] = rse_pf::Field::of_text(request.count("label") ? request.at("label").text : "");
    return reply;
  }
  std::string snapshot() const { return std::to_string(count); }
  void restore(const std::string &data) { count = std::stoi(data); }
};
RSE_PF_SERVICE_WITH_SNAPSHOTS(Adder)
"""


BUILT = {}
"""Paths of compiled libraries by their source texts, so that each source is compiled once."""


def compiled(folder, source, name, *flags):
    """Build *source* into ``lib.so``, or skip where there is no compiler."""
    compiler = shutil.which("c++" if name.endswith("cpp") else "cc")
    if compiler is None:
        pytest.skip("no compiler for C and C++ is installed")
    if (source, name, flags) in BUILT:
        (folder / "lib.so").write_bytes(BUILT[source, name, flags])
        return
    (folder / name).write_text(source)
    subprocess.run(
        [compiler, "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", f"-I{INCLUDE_FOLDER}", *flags, name,
         "-o", "lib.so"],
        cwd=folder, check=True,
    )  # fmt: skip
    BUILT[source, name, flags] = (folder / "lib.so").read_bytes()


def opened(folder, language, entry, source=None):
    """Return the runtime of a service written into *folder*."""
    if source is not None:
        (folder / entry).write_text(source)
    manifest = {"name": "adder", "language": language, "entry": entry, "kind": "per_robot_state"}
    (folder / "service.json").write_text(json.dumps(manifest))
    return open_runtime(read_service(folder), folder)


@pytest.fixture(params=["python", "lua", "cpp"])
def adder(request, tmp_path):
    """A function that opens the same service, in each of the three languages."""
    if request.param == "cpp":
        compiled(tmp_path, CPP, "adder.cpp", "-std=c++17")
    source = {"python": PYTHON, "lua": LUA, "cpp": None}[request.param]
    entry = {"python": "service.py", "lua": "service.lua", "cpp": "lib.so"}[request.param]
    return lambda: opened(tmp_path, request.param, entry, source)


@pytest.mark.parametrize("values", [[1.5, 2.0], np.array([1.5, 2.0]), np.array([1.5, 2.0], np.float32)])
def test_every_language_receives_the_payload_as_it_was_sent(adder, values):
    reply = plain(adder().call({"values": values, "label": "é"}))

    assert reply == {"total": 3.5, "count": 1, "label": "é"}


def test_every_language_keeps_state_and_restores_a_snapshot(adder):
    first = adder()
    for _ in range(3):
        first.call({"values": [1.0]})
    second = adder()
    assert second.has_snapshots
    second.restore(first.snapshot())

    assert plain(second.call({"values": [1.0]}))["count"] == 4


def test_every_language_has_typed_failures(adder):
    service = adder()

    with pytest.raises(DegenerateGeometry, match="negative"):
        service.call({"values": [-1.0]})
    with pytest.raises(RsePfError) as caught:
        service.call({})
    assert caught.value.code == "bad-request"
    assert plain(service.call({"values": [1.0]}))["count"] == 1, "a failure changes nothing"


def test_a_defect_of_a_script_is_an_internal_error_with_its_line(tmp_path):
    service = opened(tmp_path, "lua", "service.lua", LUA)

    with pytest.raises(InternalError, match=r"service\.lua:10: .*nil value"):
        service.call({"values": [1.0], "label": "oops"})
    assert service.call({"values": [1.0], "label": "zlib"})["total"] == 1


@pytest.mark.parametrize(
    ("language", "entry", "source", "says"),
    [
        ("python", "service.py", "import nothing_of_this_name", "ModuleNotFoundError"),
        ("python", "service.py", "x = 1", "neither a function serve"),
        ("python", "service.py", "def serve(request): pass", r"msgspec\.Struct"),
        ("lua", "service.lua", "return function(", "cannot be loaded"),
        ("lua", "service.lua", "return 5", "neither a function"),
        ("lua", "service.lua", "return {serve = 5}", "neither a function"),
        ("cpp", "lib.so", "no library", "cannot be loaded"),
    ],
)
def test_a_service_that_cannot_be_loaded_is_one_line(tmp_path, language, entry, source, says):
    with pytest.raises(ConfigurationError, match=says):
        opened(tmp_path, language, entry, source)


def test_a_script_has_no_access_to_python(tmp_path):
    service = opened(
        tmp_path, "lua", "service.lua",
        "local json = require 'json'\nreturn function(r) return {p = tostring(python), ok = pcall(function() "
        "return json.encode.__globals__ end)} end",
    )  # fmt: skip

    assert service.call({}) == {"p": "nil", "ok": False}


@pytest.mark.parametrize(
    "payload", [[1.0], {"values": {"a": 1}}, {"values": [[1.0], [1.0, 2.0]]}, {"values": [float("nan")]}]
)
def test_a_library_sees_only_numbers_and_texts(tmp_path, payload):
    compiled(tmp_path, CPP, "adder.cpp", "-std=c++17")
    service = opened(tmp_path, "cpp", "lib.so")

    with pytest.raises(BadRequest):
        service.call(payload)


def test_a_matrix_keeps_its_shape_on_its_way_into_a_library(tmp_path):
    source = CPP.replace("double total = 0;", 'double total = request.at("values").shape.size();')
    compiled(tmp_path, source, "adder.cpp", "-std=c++17")
    service = opened(tmp_path, "cpp", "lib.so")

    assert service.call({"values": [[0.0, 0.0], [0.0, 0.0]]})["total"] == 2
    assert service.call({"values": 0.0})["total"] == 0


def plain(reply):
    """Return a reply of any language as a dictionary."""
    if isinstance(reply, dict):
        return reply
    return {name: getattr(reply, name) for name in reply.__struct_fields__}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("return Reply(total=request.values.sum(), count=self.count, label=request.label)",
         'return {"total": 1.0}', "type dict, not with its Reply"),
        ("self.count += 1", "return", "type NoneType, not with its Reply"),
    ],
)  # fmt: skip
def test_a_reply_of_another_type_is_refused_as_such(tmp_path, old, new, says):
    service = opened(tmp_path, "python", "service.py", PYTHON.replace(old, new))

    with pytest.raises(InternalError, match=says):
        service.call({"values": [1.0]})


@pytest.mark.parametrize("state", ["{'count': 1}", "7", "'text'", "None"])
def test_a_snapshot_that_is_not_bytes_is_refused_as_such(tmp_path, state):
    source = PYTHON.replace("str(self.count).encode()", state)
    service = opened(tmp_path, "python", "service.py", source)

    with pytest.raises(InternalError, match="not bytes") as told:
        service.snapshot()
    assert "msgpack" in told.value.hint


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("total=request.values.sum()", 'total="many"', "a total of type str, not with its float"),
        ("count=self.count", "count=1.5", "a count of type float, not with its int"),
        ("count=self.count", "count=True", "a count of type bool, not with its int"),
        ("label=request.label", "label=None", "a label of type NoneType, not with its str"),
    ],
)
def test_a_field_of_another_type_than_declared_is_refused_by_its_name(tmp_path, old, new, says):
    service = opened(tmp_path, "python", "service.py", PYTHON.replace(old, new))

    with pytest.raises(InternalError, match=says) as told:
        service.call({"values": [1.0]})
    assert "annotated" in told.value.hint


FITTING = """
from __future__ import annotations
import typing
import msgspec
import numpy as np
from rse_pf.wire.arrays import Array

class Request(msgspec.Struct): pass
class Part(msgspec.Struct): x: float = 1.0
class Reply(msgspec.Struct):
    a: float = 1
    b: float = np.float32(1)
    c: Array = msgspec.field(default_factory=lambda: [1.0])
    d: list[float] = msgspec.field(default_factory=lambda: np.zeros(2))
    e: str | None = None
    f: typing.Optional[Part] = None
    g: typing.Any = None
    h: dict[str, float] = {}
    i: bytes = msgspec.field(default_factory=lambda: memoryview(b"x"))
    j: Part = msgspec.field(default_factory=Part)
    k: typing.Literal["a", "b"] = "a"

def serve(request: Request) -> Reply: return Reply()
"""


def test_what_fits_on_the_wire_fits_its_annotation(tmp_path):
    assert opened(tmp_path, "python", "service.py", FITTING).call({}).a == 1


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("return function() return {f = print} end", "the reply of service 'adder' holds a function"),
        ("local t = {} t.t = t return function() return t end", "a table that holds itself"),
        ("return {takes_text = true, serve = function() return {} end}", "with a table, not with JSON text"),
        ("return {takes_text = true, serve = function() return 'x' end}", "text that is not JSON"),
    ],
)
def test_a_reply_of_a_script_that_no_message_can_hold_is_refused_as_such(tmp_path, script, says):
    with pytest.raises(InternalError, match=says) as told:
        opened(tmp_path, "lua", "service.lua", script).call({})
    assert told.value.hint


def test_a_snapshot_of_a_script_that_cannot_be_kept_is_refused_as_such(tmp_path):
    service = opened(
        tmp_path, "lua", "service.lua", LUA.replace("return {count = count} end", "return print end")
    )

    with pytest.raises(InternalError, match="the snapshot of service 'adder' holds a function") as told:
        service.snapshot()
    assert told.value.hint


C_WRONG = """
#include <stddef.h>
#include "rse_pf_service.h"
static double number = 7;
static rse_pf_field field;
uint32_t rse_pf_service_abi(void) { return RSE_PF_SERVICE_ABI; }
int rse_pf_service_open(const char *scratch, void **state) { (void)scratch; *state = 0; return 0; }
void rse_pf_service_close(void *state) { (void)state; }
void rse_pf_service_free(void *state, void *memory) { (void)state; (void)memory; }
int rse_pf_service_snapshot(void *state, uint8_t **data, uint64_t *size) {
  (void)state; *data = NULL; *size = 5; return 0;
}
int rse_pf_service_restore(void *state, const uint8_t *data, uint64_t size) {
  (void)state; (void)data; return size == 0;
}
int rse_pf_service_call_arrays(void *state, const rse_pf_field *request, uint32_t count, rse_pf_field **reply,
                               uint32_t *fields) {
  (void)state; (void)count;
  field = (rse_pf_field){"x", RSE_PF_FLOAT64, 1, {1}, 1, &number};
  *reply = &field; *fields = 1;
  switch ((int)*(const double *)request[0].data) {
    case 1: field.type = 9; break;
    case 2: field.data = NULL; break;
    case 3: field.name = NULL; break;
    case 4: field.rank = 9; break;
    case 5: field.shape[0] = 3; break;
    case 6: field.count = 1ull << 60; break;
    case 7: *reply = NULL; break;
    case 8: *fields = 5000; break;
  }
  return RSE_PF_OK;
}
"""


def test_a_wrong_reply_of_a_library_is_refused_before_it_is_read(tmp_path):
    compiled(tmp_path, C_WRONG, "wrong.c")
    service = opened(tmp_path, "cpp", "lib.so")
    says = (
        "of type 9", "at NULL", "without a name", "of rank 9", "its shape does not hold", "too large",
        "1 fields at NULL", "5000 fields",
    )  # fmt: skip

    assert service.call({"case": 0}) == {"x": [7.0]}
    for case, each in enumerate(says, 1):
        with pytest.raises(InternalError, match=each) as told:
            service.call({"case": case})
        assert told.value.hint
    with pytest.raises(InternalError, match="a snapshot of 5 bytes at NULL"):
        service.snapshot()
