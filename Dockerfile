# Nafir's server: no torch, no training side. Runs as a numeric user on a read-only file system:
#   docker build -t nafir . && docker run --read-only -p 8000:8000 nafir
ARG BASE=python:3.11-slim

FROM ${BASE} AS builder
WORKDIR /source
# An environment without pip: the outer pip installs into it, and the image carries no installer.
RUN python -m venv --without-pip /opt/nafir
# Dependencies come before the code, so that a change of code reuses their layer.
# `make lock` writes the file of exact versions and of digests that each download has to have.
COPY requirements.lock ./
RUN python -m pip --python /opt/nafir/bin/python install --no-cache-dir --require-hashes --requirement requirements.lock
COPY LICENSE README.md pyproject.toml ./
COPY server server
# Without `training` beside it the package is the server alone, so its other command goes.
RUN python -m pip --python /opt/nafir/bin/python install --no-cache-dir --no-deps . \
    && rm /opt/nafir/bin/nafir-train
# What renders is compiled here, for this machine's processor, and kept beside its source; on another processor a
# container compiles at its start, a matter of half a minute, and keeps that where NUMBA_CACHE_DIR says.
WORKDIR /
RUN /opt/nafir/bin/python -c "from server.rendering.warm_up import warm_up; warm_up([256])" \
    && /opt/nafir/bin/nafir ir apartment --listener 1,2,1.5 --emitter 6,3,1.5 -o /tmp/ir.wav && rm /tmp/ir.wav \
    && /opt/nafir/bin/nafir bench field --rounds 1 --poses 2
WORKDIR /source

FROM ${BASE}
LABEL org.opencontainers.image.title="Nafir" \
      org.opencontainers.image.description="A real-time neural acoustic field renderer" \
      org.opencontainers.image.licenses="MIT"
# For streams in Opus; without it they are refused.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libopus0 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=builder /opt/nafir /opt/nafir
ENV PATH=/opt/nafir/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    NAFIR_HOST=0.0.0.0 \
    NAFIR_PORT=8000
USER 10001:10001
EXPOSE 8000
# The slim image has no curl. http.client, unlike urllib, takes no notice of a proxy in the environment.
HEALTHCHECK --interval=15s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import http.client, os, sys; c = http.client.HTTPConnection('127.0.0.1', int(os.environ['NAFIR_PORT']), timeout=4); c.request('GET', '/readyz'); sys.exit(c.getresponse().status != 200)"]
ENTRYPOINT ["nafir"]
CMD ["serve"]
