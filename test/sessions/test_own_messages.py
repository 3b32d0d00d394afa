"""Messages that a session receives from itself."""

from hmt_ros.nodes import own_messages
from hmt_ros.nodes.own_messages import OwnMessages

HEAD = b'\x00\x01\x00\x00'


def test_each_message_comes_back_once():
    own = OwnMessages()
    own.sent(HEAD + b'one')
    own.sent(HEAD + b'two')
    own.sent(HEAD + b'one')
    assert not own.is_own(HEAD + b'three')
    # The middleware pads the end and puts the padding's length into the header.
    assert own.is_own(b'\x00\x01\x00\x01one\0')
    assert own.is_own(HEAD + b'one')
    assert not own.is_own(HEAD + b'one')
    assert own.is_own(HEAD + b'two')


def test_what_never_comes_back_is_forgotten(monkeypatch):
    monkeypatch.setattr(own_messages, '_MAX_OWN_MESSAGES', 3)
    own = OwnMessages()
    for k in range(5):
        own.sent(HEAD + bytes([k + 1]))
    assert [own.is_own(HEAD + bytes([k + 1])) for k in range(5)] == [False, False, True, True, True]
