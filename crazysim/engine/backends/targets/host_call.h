// How XLA calls the kernel: its foreign function interface, version and all.
extern "C" __attribute__((visibility("default"))) XLA_FFI_Error* crazysim_advance(XLA_FFI_CallFrame* frame) {
  for (auto* e = frame->extension_start; e != nullptr; e = e->next) {
    if (e->type != XLA_FFI_Extension_Metadata) continue;
    XLA_FFI_Metadata* metadata = ((XLA_FFI_Metadata_Extension*)e)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    return nullptr;
  }
  advance((XLA_FFI_Buffer**)frame->args.args, (XLA_FFI_Buffer**)frame->rets.rets);
  return nullptr;
}
