// Plain C for the functions of CMSIS that the firmware's filter calls.
#pragma once
#include <stdint.h>
#include <math.h>
#include <string.h>
#include <stdbool.h>
typedef float float32_t;
typedef struct { uint16_t numRows, numCols; float *pData; } arm_matrix_instance_f32;
typedef int arm_status;
#define ARM_MATH_SUCCESS 0
static inline float arm_cos_f32(float x){return cosf(x);} static inline float arm_sin_f32(float x){return sinf(x);}
static inline arm_status arm_sqrt_f32(float x,float*y){*y=sqrtf(x);return 0;}
static inline arm_status arm_mat_trans_f32(const arm_matrix_instance_f32*a,arm_matrix_instance_f32*b){for(int i=0;i<a->numRows;i++)for(int j=0;j<a->numCols;j++)b->pData[j*a->numRows+i]=a->pData[i*a->numCols+j];return 0;}
static inline arm_status arm_mat_mult_f32(const arm_matrix_instance_f32*a,const arm_matrix_instance_f32*b,arm_matrix_instance_f32*c){for(int i=0;i<a->numRows;i++)for(int j=0;j<b->numCols;j++){float s=0;for(int k=0;k<a->numCols;k++)s+=a->pData[i*a->numCols+k]*b->pData[k*b->numCols+j];c->pData[i*b->numCols+j]=s;}return 0;}
static inline arm_status arm_mat_inverse_f32(const arm_matrix_instance_f32*a,arm_matrix_instance_f32*b){return 0;}
static inline arm_status arm_mat_scale_f32(const arm_matrix_instance_f32*a,float s,arm_matrix_instance_f32*b){for(int i=0;i<a->numRows*a->numCols;i++)b->pData[i]=a->pData[i]*s;return 0;}
#define PI 3.14159265358979f
