# For CPUs:        docker build -t race .
#                  docker run --rm -v "$PWD:/work" race train probe/target
# For CUDA:        docker build -t race:cuda --build-arg EXTRA=cuda .
#                  docker run --rm --gpus all -v "$PWD:/work" race:cuda train micro/2s3z
# CUDA itself comes with JAX's packages; the machine has the driver and the container toolkit.
# Other extras:    --build-arg EXTRA=onnx,pettingzoo
FROM python:3.11-slim AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY race race
RUN python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.11-slim
ARG EXTRA=""
# Videos without a display.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /wheels /wheels
RUN python -m pip install --no-cache-dir "$(ls /wheels/*.whl)${EXTRA:+[$EXTRA]}" && rm -r /wheels
# Anybody may run it (--user), and write its cache.
ENV HOME=/tmp PYTHONUNBUFFERED=1
RUN useradd --create-home race
USER race
WORKDIR /work
ENTRYPOINT ["race"]
CMD ["--help"]
