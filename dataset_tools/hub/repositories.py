"""The Hugging Face Hub: uploads that readers see whole or not at all, and its refusals as one sentence each.

LeRobot's own ``push_to_hub`` is not used: it leaves the files of an earlier, larger dataset in the repository, which
LeRobot then reads as part of the new one; it commits the card apart from the data; and it has the card checked at
huggingface.co even where ``HF_ENDPOINT`` names another Hub.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import httpx
from huggingface_hub import HfApi, constants, get_token
from huggingface_hub.errors import (
    GatedRepoError,
    HfHubHTTPError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

Kind = Literal["dataset", "model"]
REPLACED = ["data/*", "meta/*", "videos/*"]
"""Files of an earlier version of a dataset that go when the new version lacks them."""
UNFINISHED = ["images/*", "*.tmp"]
"""What a LeRobot recording leaves beside a dataset."""
LOGIN = "log in with `hf auth login` or set HF_TOKEN"


@contextmanager
def explained(repo_id: str) -> Iterator[None]:
    """Turn what the Hub refuses into a ValueError that names ``repo_id`` and says what to do; other errors pass."""
    try:
        yield
    except (OSError, RuntimeError, httpx.HTTPError, json.JSONDecodeError) as error:
        sentence = _sentence(error, repo_id)
        if sentence is None:
            raise
        raise ValueError(sentence) from error


def _sentence(error: BaseException, repo_id: str) -> str | None:
    """What to tell the user, judged by the first link of the chain of causes that is the Hub's; None if none is."""
    hub = constants.ENDPOINT
    cause: BaseException | None = error
    while cause is not None:
        match cause:
            case OfflineModeIsEnabled():
                return f"{repo_id} is not on this machine, and HF_HUB_OFFLINE is set: unset it to ask {hub}"
            case LocalTokenNotFoundError():
                return f"there is no access token for {repo_id} on {hub}: {LOGIN}"
            case RepositoryNotFoundError() | GatedRepoError():
                return _hidden(repo_id)
            case RevisionNotFoundError():
                return f"{repo_id} on {hub} has no such revision: {cause.response.url.path}"
            case HfHubHTTPError(response=httpx.Response() as response):
                return _refusal(response, repo_id)
            case httpx.TransportError():
                return (
                    f"no connection to {hub} for {repo_id} ({cause}); check the network and HF_ENDPOINT, then give the "
                    "same command again: files that have arrived are not sent twice"
                )
            case json.JSONDecodeError():
                return f"{hub} does not answer as a Hub does, asked for {repo_id}; check HF_ENDPOINT"
        cause = cause.__cause__
    if isinstance(error, RuntimeError) and "codebase version" in str(error):
        return f"{repo_id} on {hub} has no version tag: it is no LeRobot dataset, or its upload is not finished"
    return None


def _hidden(repo_id: str) -> str:
    who = "the token's user may not see it" if get_token() else "there is no access token"
    return f"{constants.ENDPOINT} shows no {repo_id}: it does not exist, or it is private and {who}; {LOGIN}"


def _refusal(response: httpx.Response, repo_id: str) -> str:
    if response.status_code == 401 and get_token() is None:
        return _hidden(repo_id)  # the client tells this from other refusals on some of the Hub's pages only
    reason = response.headers.get("X-Error-Message") or response.reason_phrase
    if response.status_code in (401, 403):
        return f"{constants.ENDPOINT} refuses {repo_id} ({reason}): {LOGIN}, with a token that may write to it"
    return f"{constants.ENDPOINT} refuses {repo_id} ({response.status_code} {reason}); is HF_ENDPOINT right?"


def prepare(repo_id: str, private: bool, kind: Kind = "dataset") -> str:
    """Make sure that there is a repository to upload to; returns its address.

    Called before long work, too, so that a missing token is not found out after it.

    Raises:
        ValueError: the Hub refuses, or the repository is there and public though ``private`` is asked for.
    """
    if repo_id.count("/") != 1:
        raise ValueError(f"repo_id is {repo_id!r}; on the Hub it is user/name")
    api = HfApi()
    with explained(repo_id):
        api.whoami()
        url = api.create_repo(repo_id, private=private or None, repo_type=kind, exist_ok=True)
        public = private and not api.repo_info(repo_id, repo_type=kind).private
    if public:
        raise ValueError(f"{url} exists and is public; make it private in its settings, or choose another repo_id")
    return str(url)


def upload_dataset(root: Path, repo_id: str, version: str) -> None:
    """Replace the dataset in a repository by the one in ``root``.

    LeRobot reads the commit tagged with the format's version. The tag is set when all files are there, so a broken
    upload changes nothing for readers; repeated, it sends only what has not arrived.

    Args:
        root: the dataset.
        repo_id: where to; must exist.
        version: of the dataset's format, such as v3.0.

    Raises:
        ValueError: the Hub refuses, or the connection breaks.
    """
    api = HfApi()
    with explained(repo_id):
        commit = api.upload_folder(
            repo_id=repo_id,
            folder_path=root,
            repo_type="dataset",
            commit_message="Upload dataset",
            delete_patterns=REPLACED,
            ignore_patterns=[*UNFINISHED],
        )
        tags = {tag.name: tag.target_commit for tag in api.list_repo_refs(repo_id, repo_type="dataset").tags}
        if tags.get(version) != commit.oid:
            if version in tags:
                api.delete_tag(repo_id, tag=version, repo_type="dataset")
            api.create_tag(repo_id, tag=version, revision=commit.oid, repo_type="dataset")


def upload_checkpoint(folder: Path, repo_id: str) -> None:
    """Upload a checkpoint's weights, configuration, processors and card in one commit.

    Raises:
        ValueError: the Hub refuses, or the connection breaks.
    """
    with explained(repo_id):
        HfApi().upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            commit_message="Upload policy",
            allow_patterns=["*.safetensors", "*.json", "*.yaml", "*.md"],
        )
