"""Files that stand in for others: pointers of Git LFS, pages of a web server in place of a download, zip files."""

from pathlib import Path

_LFS = b"version https://git-lfs.github.com/spec/"
_ZIP = b"PK\x03\x04"
_HTML = (b"<!doctype html", b"<html")


def what_instead(head: bytes) -> str:
    """What the first bytes of a file are in place of its content, with what to do; empty where they may be the content."""
    if head.startswith(_LFS):
        return "a Git LFS pointer in place of the file; `git lfs pull` fetches it"
    if head.startswith(_ZIP):
        return "a zip file; `unzip` it and name what was in it"
    if head[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith(_HTML):
        advice = "download it again while signed in, or with `git lfs pull` where it is in Git LFS"
        return f"an HTML page (of a sign-in or an error) in place of the file; {advice}"
    return ""


def what_file_instead(path: Path) -> str:
    """The same of the file at `path`; empty for what is no regular file or cannot be read."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return what_instead(file.read(512))
    except OSError:
        return ""
