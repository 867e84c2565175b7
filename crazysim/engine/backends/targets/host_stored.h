// Numbers that the backward pass stores of each step of an interval. They are stored for one vector of lanes at a time,
// so that they stay in the core's cache.
#define STATE_NUMBER(state, k) (stored + (size_t(state) * N_STORED + k) * (MAX_NUMBER_BYTES * W))
#define STORED_BYTES (size_t(n_steps / interval + 1 + interval) * N_STORED * (MAX_NUMBER_BYTES * W))
#define STORE_STATE(T, state, k, x) store_state(STATE_NUMBER(state, k), T##_lanes(x));
#define LOAD_STATE(T, state, k) load_state<vec<T>::type>(STATE_NUMBER(state, k))
template <class V> FN void store_state(char* p, V x) { memcpy(p, &x, sizeof(x)); }
template <class V> FN V load_state(const char* p) { V x; memcpy(&x, p, sizeof(x)); return x; }
