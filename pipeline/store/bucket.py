"""Keys of an S3 bucket, with as few requests as possible.

s3fs itself makes an extra request for an empty listing and two before a deletion, and lists names without sizes. It
also treats ``*``, ``?`` and ``[`` in paths as patterns and ignores keys that it has no permission to delete.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import Any

from zarr.storage import FsspecStore

_DELETED_AT_ONCE = 1000


class BucketStore(FsspecStore):
    """Keys below a prefix of a bucket. Only keys that start with the prefix are ever listed or deleted."""

    @classmethod
    def open_url(cls, url: str, options: dict[str, Any]) -> BucketStore:
        """Open ``s3://bucket/prefix``. ``options``: of s3fs. Raises ImportError without s3fs."""
        found = FsspecStore.from_url(url, storage_options=options)
        return cls(fs=found.fs, path=found.path)

    @property
    def _bucket(self) -> str:
        return self.path.partition("/")[0]

    @property
    def _root(self) -> str:
        """Common start of all keys in the bucket: empty, or a path that ends with a slash."""
        root = self.path.partition("/")[2]
        return root and f"{root}/"

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """See ZarrStore.list_prefix."""
        for name in await self._sizes(prefix):
            yield name

    async def getsize_prefix(self, prefix: str) -> int:
        """See ZarrStore.getsize_prefix."""
        return sum((await self._sizes(prefix)).values())

    async def delete_dir(self, prefix: str) -> None:
        """See ZarrStore.delete_dir."""
        keys = list(await self._sizes(prefix.rstrip("/") + "/"))
        for first in range(0, len(keys), _DELETED_AT_ONCE):
            await self._delete(keys[first : first + _DELETED_AT_ONCE])

    async def delete(self, key: str) -> None:
        """See ZarrStore.delete."""
        await self._delete([key])

    async def _sizes(self, prefix: str) -> dict[str, int]:
        """Bytes of every key that starts with ``prefix``."""
        found = await self.fs._find(self._bucket, prefix=self._root + prefix, detail=True)
        return {name.removeprefix(f"{self.path}/"): int(info["size"]) for name, info in found.items()}

    async def _delete(self, keys: Sequence[str]) -> None:
        """Delete up to a thousand keys; missing ones are no error. Raises PermissionError if S3 refuses."""
        names = {"Objects": [{"Key": self._root + key} for key in keys], "Quiet": True}
        answer: dict[str, Any] = await self.fs._call_s3("delete_objects", Bucket=self._bucket, Delete=names)
        for error in answer.get("Errors", ()):
            raise PermissionError(f"{error.get('Key')} cannot be deleted: {error.get('Message') or error.get('Code')}")
