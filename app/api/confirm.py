"""The route that records confirmed scenes for `training adapt`.

The route exists only with an API key and `SCENE_RECORDING`, because it writes to a file of the
service. The file is for one replica: several replicas need files of their own.
"""

from fastapi import APIRouter
from pydantic_core import to_json
from starlette.requests import Request

from app.api.body import JSONRoute
from app.api.openapi import error_responses, operation_id
from app.api.questions import read_for
from app.errors import NotRecordedError
from app.questions.names import LookUps, Unknown
from app.serving.runtime import Runtime
from scene_client.schemas import ConfirmAnswer, ConfirmRequest

router = APIRouter(
    tags=["recording"],
    route_class=JSONRoute,
    responses=error_responses(
        *("admission", "body", "models", "name", "model", "scene", "recording")
    ),
    generate_unique_id_function=operation_id,
)


@router.post("/confirm", summary="Record a confirmed scene", response_model=ConfirmAnswer)
async def confirm(data: ConfirmRequest, http: Request) -> bytes:
    """Append a scene in which everything is right to the recording of the service.

    `training adapt` learns from the recording. One confirmed scene covers a habit: new weights
    make its objects likelier in rooms of its type, and exceptions raise no alarm in any room.
    """
    runtime: Runtime = http.app.state.runtime
    state, recorder = http.scope["state"], runtime.recorder
    artifact = runtime.models.resolve(data.model)

    def write(_: object) -> str:
        """Check the scene as a question does, and write it."""
        unknown = Unknown(artifact.model.vocabulary, data.unknown_labels, LookUps())
        reading = read_for(data, artifact, runtime.limits, unknown)
        decided = {one.object for one in reading.resolved}
        label_of = {one.id: one.label for one in reading.scene.objects if one.id in decided}
        objects = [
            one
            if isinstance(one, str) or (label := label_of.get(one.id or one.label)) is None
            else one.model_copy(update={"label": label})
            for one in data.objects
        ]
        scene = data.model_copy(update={"objects": objects})
        scene_id = None if recorder is None else recorder.confirm(scene)
        if scene_id is None:
            raise NotRecordedError
        return scene_id

    scene_id = await runtime.admission.in_worker(state["ticket"], write)
    answer = ConfirmAnswer(request_id=state["request_id"], scene_id=scene_id)
    return to_json(answer)
