// Fake CUDA driver that reports one GPU, for tests of code that queries the driver.
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { NO_DEVICE = 100, INVALID_IMAGE = 200, NOT_SUPPORTED = 801, MISMATCH = 803 };

static int fails_with(int error, const char *name) {
  const char *wanted = getenv("GLOBALSPLAT_FAKE_DRIVER");
  return wanted != NULL && strcmp(wanted, name) == 0 ? error : 0;
}

int cuInit(unsigned flags) {
  (void)flags;
  return fails_with(NO_DEVICE, "no device") + fails_with(MISMATCH, "mismatch");
}
int cuDriverGetVersion(int *version) { return *version = 13000, 0; }
int cuDeviceGetCount(int *count) { return *count = 1, 0; }
int cuDeviceGet(int *device, int number) { return *device = number, 0; }
int cuDeviceGetName(char *name, int length, int device) {
  (void)device;
  strncpy(name, "Imaginary", (size_t)length);
  return 0;
}
int cuDeviceTotalMem_v2(size_t *bytes, int device) {
  (void)device;
  return *bytes = (size_t)8 << 30, 0;
}
// Compute capability 9.0.
int cuDeviceGetAttribute(int *value, int attribute, int device) {
  (void)device;
  return *value = attribute == 75 ? 9 : attribute == 76 ? 0 : 132, 0;
}
int cuDevicePrimaryCtxRetain(void **context, int device) {
  (void)device;
  return *context = context, 0;
}
int cuCtxSetCurrent(void *context) { return context == NULL; }
int cuModuleLoadData(void **module, const void *image) {
  *module = module;
  return memcmp(image, "\177ELF", 4) == 0 ? 0 : INVALID_IMAGE;
}
// Nothing is launched here.
int cuModuleGetFunction(void) { return NOT_SUPPORTED; }
int cuLaunchKernel(void) { return NOT_SUPPORTED; }
int cuGetErrorName(int error, const char **name) {
  *name = error == MISMATCH ? "CUDA_ERROR_SYSTEM_DRIVER_MISMATCH" : "CUDA_ERROR_UNKNOWN";
  return 0;
}
int cuGetErrorString(int error, const char **words) {
  *words = error == MISMATCH ? "system has unsupported display driver / cuda driver combination" : "unknown error";
  return 0;
}

// What NVRTC asks for, if there is a driver.
int cuGetExportTable(const void **table, const void *id) {
  (void)table, (void)id;
  return NOT_SUPPORTED;
}
