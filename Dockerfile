# Nafir's server: no torch, no training side. Runs as a numeric user on a read-only file system:
#   docker build -t nafir . && docker run --read-only -p 8000:8000 nafir
ARG BASE=python:3.13-slim

# The library of LLVM that compiles the kernels, for the processor of this machine alone: the one in llvmlite's package can
# compile for some twenty kinds, and is three and a half times as large. Sources are those of the lock file, LLVM is Debian's.
FROM ${BASE} AS llvm
WORKDIR /source
RUN apt-get update && apt-get install --yes --no-install-recommends llvm-22-dev cmake g++ make zlib1g-dev libzstd-dev
RUN cd /usr/lib/llvm-22 && target=$(bin/llvm-config --host-target | sed 's/^x86_64.*/X86/; s/^aarch64.*/AArch64/') \
    && sed -i "s/^set(LLVM_TARGETS_TO_BUILD .*/set(LLVM_TARGETS_TO_BUILD $target)/" lib/cmake/llvm/LLVMConfig.cmake \
    && sed -i "/^LLVM_[A-Z_]*(/{/($target)/!d}" include/llvm/Config/*.def
COPY requirements.lock ./
RUN sed -n '/^llvmlite==/,/[^\\]$/p' requirements.lock > llvmlite.lock \
    && LLVM_DIR=/usr/lib/llvm-22/lib/cmake/llvm LLVMLITE_LTO=OFF LDFLAGS='-Wl,--gc-sections -Wl,-z,pack-relative-relocs' \
        python3 -m pip wheel --no-deps --no-binary llvmlite --require-hashes --requirement llvmlite.lock --wheel-dir /wheels

# NumPy with SciPy's OpenBLAS, so that there is one: in their packages each has its own, of 25 MB.
FROM ${BASE} AS numpy
WORKDIR /source
RUN apt-get update && apt-get install --yes --no-install-recommends g++ pkgconf \
    && { test -f "$(python3 -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h" \
        || apt-get install --yes --no-install-recommends python3-dev; }
COPY requirements.lock ./
RUN for package in numpy scipy; do sed -n "/^$package==/,/[^\\]\$/p" requirements.lock > $package.lock; done \
    && python3 -m pip install --no-deps --no-compile --require-hashes --requirement scipy.lock --target scipy \
    && printf 'Name: scipy-openblas\nDescription: OpenBLAS\nVersion: 0.3\nLibs: -L%s -l:%s\nCflags: -DBLAS_SYMBOL_PREFIX=scipy_\n' \
        /source/scipy/scipy.libs "$(basename scipy/scipy.libs/libscipy_openblas-*.so)" > scipy-openblas.pc \
    && PKG_CONFIG_PATH=/source LD_LIBRARY_PATH=/source/scipy/scipy.libs LDFLAGS='-Wl,-rpath,$ORIGIN/../../scipy.libs' \
        python3 -m pip wheel --no-deps --no-binary numpy --require-hashes --requirement numpy.lock --wheel-dir /wheels \
            -Csetup-args=-Dblas=scipy-openblas -Csetup-args=-Dlapack=scipy-openblas

FROM ${BASE} AS builder
WORKDIR /source
RUN command -v strip || { apt-get update && apt-get install --yes --no-install-recommends binutils; }
# An environment without pip: the outer pip installs into it, and the image carries no installer.
RUN python -m venv --without-pip /opt/nafir
# Dependencies come before the code, so that a change of code reuses their layer.
# `make lock` writes the file of exact versions and of digests that each download has to have.
COPY requirements.lock ./
COPY --from=llvm /wheels /wheels
COPY --from=numpy /wheels /wheels
# What no server runs is left out: tests and what is compiled for them, sources and headers for compilers, symbols for
# debuggers, ONNX Runtime's tools and its second copy for C, and what Pillow has for other files than PNG. Libraries in `*.libs`
# were patched by their packagers, and stripping would break them.
RUN python -m pip --python /opt/nafir/bin/python install --no-cache-dir --no-compile --require-hashes --requirement requirements.lock \
    && python -m pip --python /opt/nafir/bin/python install --no-cache-dir --no-compile --no-deps --force-reinstall /wheels/*.whl \
    && cd /opt/nafir/lib/python3*/site-packages \
    && find . -type d -name tests -prune -exec rm -rf {} + \
    && find . \( -name '*.pyi' -o -name '*.p[xy][dx]' -o -name '*.[ahcf]' -o -name '*.hpp' \) -delete \
    && find numpy/_core \( -name '_*_tests.*.so' -o -name '_simd.*.so' \) -delete \
    && rm -rf onnxruntime/transformers onnxruntime/tools onnxruntime/quantization onnxruntime/datasets onnxruntime/backend \
    && rm -f onnxruntime/capi/libonnxruntime.so* PIL/_avif.*.so PIL/_webp.*.so PIL/_imagingft.*.so PIL/_imagingcms.*.so \
    && find . -name '*.so*' -not -path './*.libs/*' -exec strip --strip-unneeded {} +
COPY LICENSE README.md pyproject.toml ./
COPY server server
# Without `training` beside it the package is the server alone, so its other command goes.
RUN python -m pip --python /opt/nafir/bin/python install --no-cache-dir --no-deps . \
    && rm /opt/nafir/bin/nafir-train
# What renders is compiled here, for this machine's processor, and kept beside its source, where every container reads it. On
# another processor a container compiles at its start, a matter of half a minute, and keeps that in /cache if it may write there.
WORKDIR /
RUN /opt/nafir/bin/python -c "from server.rendering.warm_up import warm_up; warm_up([256])" \
    && /opt/nafir/bin/python -c "from server.acoustics.doors import compile_doors; compile_doors()" \
    && for scene in /opt/nafir/lib/python3*/site-packages/server/scene/bundles/*/; do \
        /opt/nafir/bin/python -m server.api.first_start "$scene" || exit 1; \
    done

# The environment, the interpreter, and the libraries of the system that they are linked to: no shell, no package manager.
# Streams in Opus, which are refused without it, need libopus.
FROM ${BASE} AS root
RUN apt-get update && apt-get install --yes --no-install-recommends libopus0
COPY --from=builder /opt/nafir /opt/nafir
COPY deploy/container/root.py /
RUN python3 /root.py /image /opt/nafir

FROM scratch
LABEL org.opencontainers.image.title="Nafir" \
      org.opencontainers.image.description="A real-time neural acoustic field renderer" \
      org.opencontainers.image.licenses="MIT"
COPY --from=root /image /
ENV PATH=/opt/nafir/bin:/usr/local/bin:/usr/bin:/bin \
    LANG=C.UTF-8 \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/cache \
    NAFIR_HOST=0.0.0.0 \
    NAFIR_PORT=8000
USER 10001:10001
EXPOSE 8000
# The image has no curl. http.client, unlike urllib, takes no notice of a proxy in the environment.
HEALTHCHECK --interval=15s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import http.client, os, sys; c = http.client.HTTPConnection('127.0.0.1', int(os.environ['NAFIR_PORT']), timeout=4); c.request('GET', '/readyz'); sys.exit(c.getresponse().status != 200)"]
ENTRYPOINT ["nafir"]
CMD ["serve"]
