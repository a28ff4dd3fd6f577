"""A page's policy says what a browser may run."""

from __future__ import annotations

import base64
import hashlib
import html
import re


def check_policy(page: str) -> None:
    """Check that its own scripts and styles alone run, named by hashes in the policy; no attribute holds any."""
    policy = html.unescape(re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)[0])
    rules = {words.split()[0]: words.split()[1:] for words in policy.split(";")}
    for kind in ("script", "style"):
        contents = re.findall(f"<{kind}>(.*?)</{kind}>", page, re.DOTALL)
        digests = [hashlib.sha256(content.encode()).digest() for content in contents]
        expected = {f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests}
        assert expected
        assert expected == {word for word in rules[f"{kind}-src"] if word.startswith("'sha256-")}
    assert "unsafe-inline" not in policy
    assert "{" not in policy
    tags = re.findall("<[a-z][^>]*>", re.sub("<(script|style)[^>]*>.*?</", "", page, flags=re.DOTALL))
    assert [tag for tag in tags if re.search(r'\s(style|on\w+)="', tag)] == []
