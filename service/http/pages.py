"""The page for people: GET /."""

from importlib.resources import files

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

router = APIRouter(include_in_schema=False)

_PAGE = files("service").joinpath("page/index.html").read_text(encoding="utf-8")
_POLICY = (
    "default-src 'none'; img-src 'self' blob:; connect-src 'self'; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)


@router.get("/", response_class=HTMLResponse)
async def page() -> HTMLResponse:
    """Show the live map; everything it needs comes from this service."""
    return HTMLResponse(_PAGE, headers={"Content-Security-Policy": _POLICY})
