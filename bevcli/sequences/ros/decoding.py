"""The bytes of a message -> an object with its fields: ROS 2's CDR, JSON and Protobuf."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from bevcli.errors import InputError
from bevcli.parsing.documents import parse_json

Decode = Callable[[bytes], Any]


@dataclass(frozen=True)
class Encoding:
    """How the messages of a topic are encoded.

    Attributes:
        messages: "cdr", "json" or "protobuf".
        schema: encoding of the definition: "ros2msg", "ros2idl", "jsonschema", "protobuf"; "" if there is none.
        definition: the definition of the type, empty if there is none.
    """

    messages: str
    schema: str = ""
    definition: bytes = b""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: such as "/camera/front/image_raw".
        type_name: as the bag writes it, such as "sensor_msgs/msg/Image".
        encoding: of its messages.
    """

    name: str
    type_name: str
    encoding: Encoding


def decoder(topic: Topic) -> Decode:
    """The function that decodes a topic's messages. Nested messages are objects with attributes, too.

    Raises InputError if the encoding is not supported, or the definition is broken.
    """
    makers = {"cdr": _cdr, "json": _json, "protobuf": _protobuf}
    make = makers.get(topic.encoding.messages)
    if make is None:
        raise InputError(
            f"{topic.name}: messages are encoded as {topic.encoding.messages} (expected {', '.join(makers)})"
        )
    return make(topic)


def _cdr(topic: Topic) -> Decode:
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.store import TypesysError

    name = topic.type_name if "/msg/" in topic.type_name else topic.type_name.replace("/", "/msg/")
    text = topic.encoding.definition.decode(errors="replace")
    try:
        if not text:
            store = get_typestore(Stores.LATEST)
        else:
            store = get_typestore(Stores.EMPTY)
            is_idl = topic.encoding.schema == "ros2idl"
            store.register(get_types_from_idl(text) if is_idl else get_types_from_msg(text, name))
        store.get_msgdef(name)
    except (TypesysError, KeyError, ValueError) as error:
        found = "its definition cannot be read" if text else "the bag has no definition of it, and it is not a ROS type"
        raise InputError(f"{topic.name}: type {name}: {found} ({error})") from None
    return lambda data: store.deserialize_cdr(data, name)


def _json(topic: Topic) -> Decode:
    return lambda data: _with_attributes(parse_json(data, Path(topic.name)))


def _with_attributes(value: Any) -> Any:
    """The value of a JSON document with objects that have attributes in place of dicts."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: _with_attributes(item) for name, item in value.items()})
    return [_with_attributes(item) for item in value] if isinstance(value, list) else value


def _protobuf(topic: Topic) -> Decode:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from google.protobuf.message import DecodeError

    pool = descriptor_pool.DescriptorPool()
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(topic.encoding.definition)
        _add_files(pool, {file.name: file for file in files.file})
        message = message_factory.GetMessageClass(pool.FindMessageTypeByName(topic.type_name))
    except (DecodeError, KeyError, TypeError) as error:
        raise InputError(f"{topic.name}: the definition of {topic.type_name} cannot be read ({error})") from None
    return message.FromString


def _add_files(pool: Any, files: dict[str, Any]) -> None:
    """Add files to a descriptor pool, each after the files that it imports."""
    added: set[str] = set()

    def add(name: str) -> None:
        if name in added or name not in files:
            return
        added.add(name)
        for imported in files[name].dependency:
            add(imported)
        pool.Add(files[name])

    for name in files:
        add(name)
