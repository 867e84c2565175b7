// Numbers that a gradient keeps of each step of an interval, one block of lanes at a time: near to the core.
#define KEPT_AT(state, k) (kept + (size_t(state) * N_KEPT + k) * (WIDEST * W))
#define KEPT_BYTES (size_t(n_steps / interval + 1 + interval) * N_KEPT * (WIDEST * W))
#define KEEP(T, state, k, x) put_kept(KEPT_AT(state, k), T##_lanes(x));
#define KEPT(T, state, k) take_kept<vec<T>::type>(KEPT_AT(state, k))
template <class V> FN void put_kept(char* p, V x) { memcpy(p, &x, sizeof(x)); }
template <class V> FN V take_kept(const char* p) { V x; memcpy(&x, p, sizeof(x)); return x; }
