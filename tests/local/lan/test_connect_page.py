"""The page for browsers: its own script runs, nothing else does, and nothing outside is requested."""

from __future__ import annotations

import base64
import hashlib
import re

from rse_pf.local.lan.connect_page import connect_page, page_headers


def test_the_policy_allows_the_script_and_the_style_of_the_page() -> None:
    page, policy = connect_page("/ws"), page_headers()["content-security-policy"]

    for kind in ("script", "style"):
        found = re.search(rf"<{kind}>(.*?)</{kind}>", page, re.DOTALL)
        assert found is not None
        digest = base64.b64encode(hashlib.sha256(found[1].encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert "unsafe" not in policy


def test_the_page_asks_nobody_else_and_quotes_the_path() -> None:
    page = connect_page('/ws"><script>')

    assert "http:" not in page
    assert "https:" not in page
    assert page.count("<script>") == 1
