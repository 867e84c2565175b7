// Large calls are divided among threads, in parts that are whole blocks of lanes. A block is the lanes of one vector,
// or of one world of several vectors. After a call, threads wait for the next call for a while: to start a thread takes
// 25 us, to wake a waiting thread 5 us. The caller also computes parts, until none is left.
static int64_t n_cores() {  // cores that this process may use
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof(set), &set) == 0) return CPU_COUNT(&set);
#endif
  return sysconf(_SC_NPROCESSORS_ONLN);
}
// A thread is worth about 25 us of work, OPERATIONS_PER_THREAD operations on vectors. To load and store a block takes as
// long as IO_STEPS steps.
#define OPERATIONS_PER_THREAD (1 << 17)
#define IO_STEPS 1
#define PARTS_PER_THREAD 8
#define MAX_THREADS 256
#define IDLE_SECONDS 2
static int64_t minimum(int64_t a, int64_t b) { return b < a ? b : a; }

// The mode of arithmetic, which determines whether subnormal numbers are treated as zero.
#if defined(__SSE2__)
#define FLUSH_SUBNORMALS 0x8040
static uint64_t arithmetic_mode() { return __builtin_ia32_stmxcsr(); }
static void set_arithmetic_mode(uint64_t x) { __builtin_ia32_ldmxcsr(unsigned(x)); }
#elif defined(__aarch64__)
#define FLUSH_SUBNORMALS (1 << 24)
static uint64_t arithmetic_mode() { uint64_t x; __asm__ volatile("mrs %0, fpcr" : "=r"(x)); return x; }
static void set_arithmetic_mode(uint64_t x) { __asm__ volatile("msr fpcr, %0" : : "r"(x) : "memory"); }
#else
#define FLUSH_SUBNORMALS 0
static uint64_t arithmetic_mode() { return 0; }
static void set_arithmetic_mode(uint64_t) {}
#endif

struct Call { int64_t n_lanes; int n_steps; void** in; void** out; int64_t n_blocks, n_parts; uint64_t arithmetic_mode; };
struct Pool {
  pthread_mutex_t call_lock;  // held by the call that uses the threads; a simultaneous call runs without them
  pthread_mutex_t lock;    // protects the fields below
  pthread_cond_t call_started;
  Call call;
  bool is_open;            // true while threads may join the call
  int64_t next_part, n_working, n_threads, n_failed;
};
#define NEW_POOL {PTHREAD_MUTEX_INITIALIZER, PTHREAD_MUTEX_INITIALIZER, PTHREAD_COND_INITIALIZER}
static Pool pool = NEW_POOL;
static void forget_threads() { pool = NEW_POOL; }
__attribute__((constructor)) static void watch_forks() { pthread_atfork(nullptr, nullptr, forget_threads); }

static void take_parts() {
  const Call c = pool.call;
  const auto first_lane = [&](int64_t k) { return minimum(c.n_lanes, c.n_blocks * k / c.n_parts * LANES_OF_BLOCK); };
  for (;;) {
    const int64_t k = __atomic_fetch_add(&pool.next_part, 1, __ATOMIC_RELAXED);
    if (k >= c.n_parts) return;
    if (!advance_range(first_lane(k), first_lane(k + 1), c.n_lanes, c.n_steps, c.in, c.out)) __atomic_fetch_add(&pool.n_failed, 1, __ATOMIC_RELAXED);
  }
}
static void* run_worker(void*) {
  pthread_mutex_lock(&pool.lock);
  for (;;) {
    timespec until;
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_sec += IDLE_SECONDS;
    while (!pool.is_open) {
      if (pthread_cond_timedwait(&pool.call_started, &pool.lock, &until) == 0 || pool.is_open) continue;
      --pool.n_threads;
      pthread_mutex_unlock(&pool.lock);
      return nullptr;
    }
    ++pool.n_working;
    pthread_mutex_unlock(&pool.lock);
    set_arithmetic_mode(pool.call.arithmetic_mode);
    take_parts();
    pthread_mutex_lock(&pool.lock);
    pool.is_open = false;
    __atomic_fetch_sub(&pool.n_working, 1, __ATOMIC_RELEASE);
  }
}
// Advances all lanes. Returns false if memory could not be allocated.
static bool advance(int64_t n_lanes, int n_steps, void** in, void** out) {
  const int64_t n_blocks = (n_lanes + LANES_OF_BLOCK - 1) / LANES_OF_BLOCK;
  const int64_t n_useful_threads = n_blocks * VECTORS * (n_steps + IO_STEPS) * OPERATIONS / OPERATIONS_PER_THREAD;
  const int64_t n_threads = n_useful_threads < 2 ? 1 : minimum(minimum(n_cores(), MAX_THREADS), n_useful_threads);
  if (n_threads < 2 || pthread_mutex_trylock(&pool.call_lock) != 0) return advance_range(0, n_lanes, n_lanes, n_steps, in, out);
  pthread_mutex_lock(&pool.lock);
  pool.call = {n_lanes, n_steps, in, out, n_blocks, minimum(n_blocks, n_threads * PARTS_PER_THREAD), arithmetic_mode()};
  pool.next_part = pool.n_failed = 0;
  pool.is_open = true;
  for (pthread_t thread; pool.n_threads < n_threads - 1; ++pool.n_threads) {
    if (pthread_create(&thread, nullptr, run_worker, nullptr) != 0) break;
    pthread_detach(thread);
  }
  pthread_mutex_unlock(&pool.lock);
  for (int64_t k = 1; k < n_threads; ++k) pthread_cond_signal(&pool.call_started);
  take_parts();
  pthread_mutex_lock(&pool.lock);
  pool.is_open = false;
  pthread_mutex_unlock(&pool.lock);
  while (__atomic_load_n(&pool.n_working, __ATOMIC_ACQUIRE) != 0) sched_yield();
  const bool has_memory = pool.n_failed == 0;
  pthread_mutex_unlock(&pool.call_lock);
  return has_memory;
}

// Entry point for XLA, with its foreign function interface. The first two operands are n_lanes and n_steps.
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
  if (advance(*(int*)data[0], *(int*)data[1], data + 2, data + n_in)) return nullptr;
  XLA_FFI_Error_Create_Args error = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, nullptr, "no memory for a kernel of crazysim", XLA_FFI_Error_Code_RESOURCE_EXHAUSTED};
  return frame->api->XLA_FFI_Error_Create(&error);
}

// Entry point without XLA. Subnormal numbers are treated as zero during the call, as XLA does in its calls.
CALLABLE int crazysim_call(int n_lanes, int n_steps, void** in, int n_in) {
  const uint64_t previous_mode = arithmetic_mode();
  set_arithmetic_mode(previous_mode | FLUSH_SUBNORMALS);
  const bool has_memory = advance(n_lanes, n_steps, in, in + n_in);
  set_arithmetic_mode(previous_mode);
  return has_memory;
}
