"""Policies on the Hugging Face Hub: two files, a model card, and nothing that could run."""

from __future__ import annotations

import contextlib
import re
import reprlib
from collections.abc import Iterator
from pathlib import Path

from torchrl_morl._extras import from_extra

from .entries import one_line
from .files import paths
from .hub_card import model_card
from .policy_files import load_policy

__all__ = ["from_hub", "push_to_hub"]

_FILES = tuple(path.name for path in paths("", "policy"))
_FILMS = (".gif", ".mp4", ".webm")


def push_to_hub(
    folder: str | Path,
    repo_id: str,
    *,
    film: str | Path | None = None,
    license: str | None = None,
    private: bool | None = None,
    token: str | None = None,
    endpoint: str | None = None,
) -> str:
    """Upload a policy, in one commit, to a repository that is made if there is none.

    It gets a model card with what the policy reads and commands, its evaluation and the film. A card that
    is there already stays as it is.

    Args:
        folder: of the policy.
        repo_id: ``"name/policy"``.

    Keyword Args:
        film: a .gif, .mp4 or .webm of it, as ``python -m recipes.film`` makes one.
        license: that the card names, such as ``"mit"``.
        private: whether only you see a repository that is made.
        token: of the Hub; that of ``hf auth login`` if ``None``.
        endpoint: of another server than the Hub.

    Returns:
        The address of the repository.

    Raises:
        FileNotFoundError: if the policy or the film is not there.
        ImportError: without the extra ``hub``.
        OSError: if the server does not take it.
        ValueError: for a folder that is no policy, a film of another kind, a license that is no
            name of one, or a ``repo_id`` that is none.
    """
    policy = load_policy(folder)  # what could not be read again is not uploaded
    files = {path.name: path for path in paths(folder, "policy")}
    shown = None
    if film is not None:
        film = Path(film)
        if film.suffix not in _FILMS:
            raise ValueError(f"film must be one of {', '.join(_FILMS)}, got {str(film)!r}.")
        if not film.is_file():
            raise FileNotFoundError(f"film {film} not found.")
        shown = f"film{film.suffix}"
        files[shown] = film
    if license is not None and not re.fullmatch(r"[a-z0-9][a-z0-9.-]*", license):
        raise ValueError(f'license must be a name such as "mit" or "cc-by-4.0", got {license!r}.')
    with from_extra("hub", "push_to_hub"):
        from huggingface_hub import CommitOperationAdd, HfApi
    api = HfApi(endpoint=endpoint, token=token)
    with _named(repo_id, api.endpoint):
        url = api.create_repo(repo_id, private=private, exist_ok=True)
        operations = [CommitOperationAdd(name, str(path)) for name, path in files.items()]
        if not api.file_exists(repo_id, "README.md"):
            card = model_card(policy, repo_id, film=shown, license=license)
            operations.append(CommitOperationAdd("README.md", card.encode()))
        api.create_commit(repo_id, operations, commit_message="Upload policy")
    return str(url)


def from_hub(
    repo_id: str,
    *,
    revision: str | None = None,
    cache_dir: str | Path | None = None,
    token: str | None = None,
    endpoint: str | None = None,
) -> Path:
    """The folder of a policy from the Hub, for :func:`load_policy` and for every ``--policy``.

    ``policy.json`` and ``policy.safetensors`` are downloaded and nothing else that the repository holds;
    they are read once, so that what is broken or was changed is refused here. Without a network, or with
    ``HF_HUB_OFFLINE=1``, it is the folder that an earlier download left in the cache.

    Args:
        repo_id: ``"name/policy"``, or a folder of this machine, which needs no extra.

    Keyword Args:
        revision: a branch, tag or commit; pin a commit where a robot drives with it.
        cache_dir: where downloads are kept; that of the Hub's other programs if ``None``.
        token: of the Hub; that of ``hf auth login`` if ``None``.
        endpoint: of another server than the Hub.

    Returns:
        The folder, in the cache: do not write into it.

    Raises:
        FileNotFoundError: if there is no such repository or revision, or it holds no policy.
        ImportError: without the extra ``hub``.
        OSError: if there is no network and nothing in the cache.
        ValueError: for files that are no policy, or a ``repo_id`` that is none.

    Example:
        >>> import tempfile
        >>> from torchrl_morl.deploy import load_policy, save_policy
        >>> from torchrl_morl.testing import untrained_policy
        >>> policy = untrained_policy()
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     folder = save_policy(
        ...         f"{parent}/mine",
        ...         policy.actor,
        ...         preference_space=policy.preference_space,
        ...         sensing=policy.sensing,
        ...         robot="mine",
        ...         card={},
        ...     )
        ...     load_policy(from_hub(str(folder))).robot
        'mine'
    """
    if Path(repo_id).is_dir():
        folder = Path(repo_id)
    else:
        with from_extra("hub", "from_hub"):
            from huggingface_hub import HfApi, snapshot_download
        server = HfApi(endpoint=endpoint).endpoint
        with _named(repo_id, server):
            folder = Path(
                snapshot_download(
                    repo_id,
                    revision=revision,
                    cache_dir=cache_dir,
                    token=token,
                    endpoint=endpoint,
                    allow_patterns=list(_FILES),
                )
            )
    load_policy(folder)
    return folder


@contextlib.contextmanager
def _named(repo_id: str, server: str) -> Iterator[None]:
    """What goes wrong between here and the server, in one line."""
    from huggingface_hub import errors

    try:
        yield
    except errors.HFValidationError as error:
        raise ValueError(
            f"repo_id must be NAME/POLICY, or a folder that is there, got {reprlib.repr(repo_id)}."
        ) from error
    except errors.RevisionNotFoundError as error:
        raise FileNotFoundError(f"{repo_id} on {server} has no such revision.") from error
    except errors.RepositoryNotFoundError as error:
        raise FileNotFoundError(
            f"{repo_id} is not on {server}, or private: log in with hf auth login, or give token=."
        ) from error
    except errors.LocalEntryNotFoundError as error:
        raise OSError(
            f"{repo_id} is not in the cache, and {server} cannot be reached: connect once, or give a "
            "folder."
        ) from error
    except Exception as error:
        # The library under huggingface_hub, and with it the errors of its connections, has changed before.
        raise OSError(f"{repo_id} on {server}: {one_line(error)}.") from error
