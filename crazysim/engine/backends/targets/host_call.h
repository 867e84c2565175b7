// Work that is worth it is shared between the cores, in parts that are whole blocks of lanes. Threads wait for the next
// call, as long as it comes soon: one that is begun for a call costs it 25 us, one that waits 5 us. No part waits for a
// thread: the caller takes all parts that nobody else has taken.
static int64_t n_cores() {  // that this process may use
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof(set), &set) == 0) return CPU_COUNT(&set);
#endif
  return sysconf(_SC_NPROCESSORS_ONLN);
}
// Operations on a block that are worth a thread: some 25 us. Loading and storing a block takes as long as a step.
#define WORTH_A_THREAD (1 << 17)
#define IO_STEPS 1
#define PARTS_OF_THREAD 8
#define MOST_THREADS 256
#define IDLE_SECONDS 2
static int64_t least(int64_t a, int64_t b) { return b < a ? b : a; }

// The mode of arithmetic, with subnormal numbers taken for zero or not.
#if defined(__SSE2__)
#define WITHOUT_SUBNORMALS 0x8040
static uint64_t mode() { return __builtin_ia32_stmxcsr(); }
static void set_mode(uint64_t x) { __builtin_ia32_ldmxcsr(unsigned(x)); }
#elif defined(__aarch64__)
#define WITHOUT_SUBNORMALS (1 << 24)
static uint64_t mode() { uint64_t x; __asm__ volatile("mrs %0, fpcr" : "=r"(x)); return x; }
static void set_mode(uint64_t x) { __asm__ volatile("msr fpcr, %0" : : "r"(x) : "memory"); }
#else
#define WITHOUT_SUBNORMALS 0
static uint64_t mode() { return 0; }
static void set_mode(uint64_t) {}
#endif

struct Call { int64_t n_lanes; int n_steps; void** in; void** out; int64_t n_blocks, n_parts; uint64_t mode; };
struct Pool {
  pthread_mutex_t in_use;  // by a call; another one meanwhile does without the threads
  pthread_mutex_t lock;    // of what follows
  pthread_cond_t begun;
  Call call;
  bool open;               // for threads to join the call
  int64_t next_part, n_at_work, n_threads, n_failed;
};
#define NEW_POOL {PTHREAD_MUTEX_INITIALIZER, PTHREAD_MUTEX_INITIALIZER, PTHREAD_COND_INITIALIZER}
static Pool pool = NEW_POOL;
static void forget_threads() { pool = NEW_POOL; }
__attribute__((constructor)) static void watch_forks() { pthread_atfork(nullptr, nullptr, forget_threads); }

static void take_parts() {
  const Call c = pool.call;
  const auto bound = [&](int64_t k) { return least(c.n_lanes, c.n_blocks * k / c.n_parts * LANES_OF_BLOCK); };
  for (;;) {
    const int64_t k = __atomic_fetch_add(&pool.next_part, 1, __ATOMIC_RELAXED);
    if (k >= c.n_parts) return;
    if (!advance_range(bound(k), bound(k + 1), c.n_lanes, c.n_steps, c.in, c.out)) __atomic_fetch_add(&pool.n_failed, 1, __ATOMIC_RELAXED);
  }
}
static void* work(void*) {
  pthread_mutex_lock(&pool.lock);
  for (;;) {
    timespec until;
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_sec += IDLE_SECONDS;
    while (!pool.open) {
      if (pthread_cond_timedwait(&pool.begun, &pool.lock, &until) == 0 || pool.open) continue;
      --pool.n_threads;
      pthread_mutex_unlock(&pool.lock);
      return nullptr;
    }
    ++pool.n_at_work;
    pthread_mutex_unlock(&pool.lock);
    set_mode(pool.call.mode);
    take_parts();
    pthread_mutex_lock(&pool.lock);
    pool.open = false;
    __atomic_fetch_sub(&pool.n_at_work, 1, __ATOMIC_RELEASE);
  }
}
// Returns false if there was no memory.
static bool advance(int64_t n_lanes, int n_steps, void** in, void** out) {
  const int64_t n_blocks = (n_lanes + LANES_OF_BLOCK - 1) / LANES_OF_BLOCK;
  const int64_t worth = n_blocks * VECTORS * (n_steps + IO_STEPS) * OPERATIONS / WORTH_A_THREAD;
  const int64_t n_threads = worth < 2 ? 1 : least(least(n_cores(), MOST_THREADS), worth);
  if (n_threads < 2 || pthread_mutex_trylock(&pool.in_use) != 0) return advance_range(0, n_lanes, n_lanes, n_steps, in, out);
  pthread_mutex_lock(&pool.lock);
  pool.call = {n_lanes, n_steps, in, out, n_blocks, least(n_blocks, n_threads * PARTS_OF_THREAD), mode()};
  pool.next_part = pool.n_failed = 0;
  pool.open = true;
  for (pthread_t thread; pool.n_threads < n_threads - 1; ++pool.n_threads) {
    if (pthread_create(&thread, nullptr, work, nullptr) != 0) break;
    pthread_detach(thread);
  }
  pthread_mutex_unlock(&pool.lock);
  for (int64_t k = 1; k < n_threads; ++k) pthread_cond_signal(&pool.begun);
  take_parts();
  pthread_mutex_lock(&pool.lock);
  pool.open = false;
  pthread_mutex_unlock(&pool.lock);
  while (__atomic_load_n(&pool.n_at_work, __ATOMIC_ACQUIRE) != 0) sched_yield();
  const bool done = pool.n_failed == 0;
  pthread_mutex_unlock(&pool.in_use);
  return done;
}

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
  if (advance(*(int*)data[0], *(int*)data[1], data + 2, data + n_in)) return nullptr;
  XLA_FFI_Error_Create_Args error = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, nullptr, "no memory for a kernel of crazysim", XLA_FFI_Error_Code_RESOURCE_EXHAUSTED};
  return frame->api->XLA_FFI_Error_Create(&error);
}

// The same call without XLA. As in XLA's own calls, subnormal numbers are taken for zero while it lasts.
CALLABLE int crazysim_call(int n_lanes, int n_steps, void** in, int n_in) {
  const uint64_t before = mode();
  set_mode(before | WITHOUT_SUBNORMALS);
  const bool done = advance(n_lanes, n_steps, in, in + n_in);
  set_mode(before);
  return done;
}
