# Stages: `runtime` (the default) serves; `ray` serves by Ray Serve; `train` trains into the same store.
#   docker build -t scene-boltzmann .
#   docker build -t scene-boltzmann-ray --target ray .
#   docker build -t scene-boltzmann-train --target train .

# The digest names the images of all architectures. `docker buildx imagetools inspect` gives a newer one.
FROM python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b AS base
ENV PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    PATH=/opt/venv/bin:$PATH
WORKDIR /srv/scene

# ---- packages of the service
FROM base AS packages
COPY requirements.lock ./
RUN python -m venv /opt/venv \
    && /opt/venv/bin/python -m pip install --no-cache-dir --disable-pip-version-check -q \
        --require-hashes -r requirements.lock

# ---- the same without pip and the packages' own tests, which nothing imports (100 MB)
FROM packages AS service-packages
RUN /opt/venv/bin/python -m pip uninstall --yes -q pip setuptools \
    && find /opt/venv -name tests -type d -prune -exec rm -rf {} +

# ---- packages of training, on top
FROM packages AS training-packages
# The index for CPU builds of torch; without it the default index may bring a CUDA build.
ARG TORCH_INDEX_URL=""
COPY requirements-training.lock requirements-torch.lock requirements-torch-cpu.lock ./
RUN /opt/venv/bin/python -m pip install --no-cache-dir --disable-pip-version-check -q \
        --require-hashes -r requirements-training.lock \
    && /opt/venv/bin/python -m pip install --no-cache-dir --disable-pip-version-check -q \
        ${TORCH_INDEX_URL:+--no-deps --require-hashes --index-url "$TORCH_INDEX_URL"} \
        -r requirements-torch${TORCH_INDEX_URL:+-cpu}.lock

# ---- training: docker run ... train --help
FROM base AS train
COPY --from=training-packages /opt/venv /opt/venv
COPY clients/python/scene_client ./scene_client
COPY app ./app
COPY training ./training
COPY --chown=10001:10001 model_store ./model_store
# Commands run in this folder. A volume mounted here belongs to the user.
RUN install -d -o 10001 -g 10001 /srv/training
# Under a read-only root, only /tmp and volumes are writable.
ENV HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib \
    NUMBA_CACHE_DIR=/srv/training/.compiled \
    PYTHONPATH=/srv/scene \
    SCENE_STORE=/srv/scene/model_store
USER 10001:10001
WORKDIR /srv/training
ENTRYPOINT ["python", "-m", "training"]
CMD ["--help"]

# ---- the service by Ray Serve; deploy/ray/rayservice.yaml gives the command
FROM packages AS ray-packages
COPY requirements-ray.lock ./
RUN /opt/venv/bin/python -m pip install --no-cache-dir --disable-pip-version-check -q \
        --require-hashes -r requirements-ray.lock

FROM base AS ray
COPY --from=ray-packages /opt/venv /opt/venv
COPY clients/python/scene_client ./scene_client
COPY app ./app
COPY deploy/ray ./deploy/ray
COPY --chown=10001:10001 model_store ./model_store
ENV NUMBA_CPU_NAME=generic \
    NUMBA_CPU_FEATURES=""
RUN NUMBA_CACHE_DIR=compiled python -m app.compile && chmod -R a+rX compiled
ENV HOME=/tmp \
    NUMBA_CACHE_DIR=/tmp/compiled \
    PYTHONPATH=/srv/scene \
    SCENE_STORE=/srv/scene/model_store
USER 10001:10001
CMD ["ray", "--help"]

# ---- the service
FROM base AS runtime
COPY --from=service-packages /opt/venv /opt/venv
COPY clients/python/scene_client ./scene_client
COPY app ./app
# A volume mounted here belongs to the service, so `python -m app.registry` can change it.
COPY --chown=10001:10001 model_store ./model_store
# docker-compose.yml mounts its volume here, and copies the shipped models into it.
RUN install -d -o 10001 -g 10001 models
# Compiled for any CPU of the architecture, so that no start compiles. Answers take 10 to 25 % longer
# than with loops for the own CPU, which `env -u NUMBA_CPU_NAME -u NUMBA_CPU_FEATURES` compiles.
# The folder is private to its owner, here root; the service copies it.
ENV NUMBA_CPU_NAME=generic \
    NUMBA_CPU_FEATURES=""
RUN NUMBA_CACHE_DIR=compiled python -m app.compile && chmod -R a+rX compiled
ENV HOME=/tmp \
    NUMBA_CACHE_DIR=/tmp/compiled \
    SCENE_HOST=0.0.0.0 \
    SCENE_PORT=8000 \
    SCENE_HEALTH_PORT=8081 \
    SCENE_STORE=/srv/scene/model_store
USER 10001:10001
LABEL org.opencontainers.image.title=scene-boltzmann \
    org.opencontainers.image.version=2.0.0 \
    org.opencontainers.image.licenses=Apache-2.0
EXPOSE 8000 8081
# http.client, unlike urlopen, never takes a proxy that the environment names.
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import http.client, os, sys; c = http.client.HTTPConnection('127.0.0.1', int(os.environ['SCENE_HEALTH_PORT']), timeout=2); c.request('GET', '/health/ready'); sys.exit(c.getresponse().status != 200)"]
# The compiler's cache must be writable, and /tmp alone is.
CMD ["sh", "-c", "mkdir -p $NUMBA_CACHE_DIR && cp -R compiled/. $NUMBA_CACHE_DIR && exec python -m app"]
