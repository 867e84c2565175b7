// How XLA calls the kernel: its foreign function interface, version and all. The first two operands are the sizes.
#define CALLABLE extern "C" __attribute__((visibility("default")))
CALLABLE XLA_FFI_Error* crazysim_advance(XLA_FFI_CallFrame* frame) {
  for (auto* e = frame->extension_start; e != nullptr; e = e->next) {
    if (e->type != XLA_FFI_Extension_Metadata) continue;
    XLA_FFI_Metadata* metadata = ((XLA_FFI_Metadata_Extension*)e)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    return nullptr;
  }
  const auto n_in = frame->args.size, n_out = frame->rets.size;
  void* data[n_in + n_out + 1];
  for (int64_t i = 0; i < n_in; ++i) data[i] = ((XLA_FFI_Buffer*)frame->args.args[i])->data;
  for (int64_t i = 0; i < n_out; ++i) data[n_in + i] = ((XLA_FFI_Buffer*)frame->rets.rets[i])->data;
  advance(*(int*)data[0], *(int*)data[1], data + 2, data + n_in);
  return nullptr;
}

// The same call without XLA. As in XLA's own calls, subnormal numbers are taken for zero while it lasts, here and in
// the threads that it begins.
CALLABLE void crazysim_call(int n_lanes, int n_steps, void** in, int n_in) {
#if defined(__SSE2__)
  const unsigned before = __builtin_ia32_stmxcsr();
  __builtin_ia32_ldmxcsr(before | 0x8040);
  advance(n_lanes, n_steps, in, in + n_in);
  __builtin_ia32_ldmxcsr(before);
#elif defined(__aarch64__)
  uint64_t before;
  __asm__ volatile("mrs %0, fpcr" : "=r"(before));
  __asm__ volatile("msr fpcr, %0" : : "r"(before | (1 << 24)) : "memory");
  advance(n_lanes, n_steps, in, in + n_in);
  __asm__ volatile("msr fpcr, %0" : : "r"(before) : "memory");
#else
  advance(n_lanes, n_steps, in, in + n_in);
#endif
}
