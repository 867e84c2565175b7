#include "kalman_core.h"
#include "mm_position.h"
#include "mm_pose.h"
#include "mm_flow.h"
#include "mm_tof.h"
#include "mm_distance.h"
#include "mm_tdoa.h"
#include "mm_sweep_angles.h"
// Calls the firmware's filter from Python; outlier filters let everything pass. Built by record_filter.py.
static kalmanCoreData_t d; static kalmanCoreParams_t p;
bool outlierFilterTdoaValidateIntegrator(OutlierFilterTdoaState_t* a, const tdoaMeasurement_t* b, const float c, const uint32_t n){return true;}
bool outlierFilterLighthouseValidateSweep(OutlierFilterLhState_t* a, const float b, const float c, const uint32_t n){return true;}
void k_init(float x,float y,float z,float yaw){kalmanCoreDefaultParams(&p);p.initialX=x;p.initialY=y;p.initialZ=z;p.initialYaw=yaw;kalmanCoreInit(&d,&p,0);}
void k_predict(float*a,float*g,unsigned ms,int fly){Axis3f A={.x=a[0],.y=a[1],.z=a[2]},G={.x=g[0],.y=g[1],.z=g[2]};kalmanCorePredict(&d,&p,&A,&G,ms,fly);}
void k_noise(unsigned ms){kalmanCoreAddProcessNoise(&d,&p,ms);}
void k_position(float*v,float s){positionMeasurement_t m={0};m.pos[0]=v[0];m.pos[1]=v[1];m.pos[2]=v[2];m.stdDev=s;kalmanCoreUpdateWithPosition(&d,&m);}
void k_pose(float*v,float*q,float s,float sq){poseMeasurement_t m={0};m.pos[0]=v[0];m.pos[1]=v[1];m.pos[2]=v[2];m.quat.x=q[0];m.quat.y=q[1];m.quat.z=q[2];m.quat.w=q[3];m.stdDevPos=s;m.stdDevQuat=sq;kalmanCoreUpdateWithPose(&d,&m);}
void k_flow(float dx,float dy,float sx,float sy,float dt,float*g){flowMeasurement_t m={0};m.dpixelx=dx;m.dpixely=dy;m.stdDevX=sx;m.stdDevY=sy;m.dt=dt;Axis3f G={.x=g[0],.y=g[1],.z=g[2]};kalmanCoreUpdateWithFlow(&d,&m,&G);}
void k_tof(float r,float s){tofMeasurement_t m={0};m.distance=r;m.stdDev=s;kalmanCoreUpdateWithTof(&d,&m);}
void k_distance(float r,float*a,float s){distanceMeasurement_t m={0};m.distance=r;m.x=a[0];m.y=a[1];m.z=a[2];m.stdDev=s;kalmanCoreUpdateWithDistance(&d,&m);}
void k_tdoa(float r,float*a,float*b,float s,unsigned ms){tdoaMeasurement_t m={0};m.distanceDiff=r;m.anchorPositions[0].x=a[0];m.anchorPositions[0].y=a[1];m.anchorPositions[0].z=a[2];m.anchorPositions[1].x=b[0];m.anchorPositions[1].y=b[1];m.anchorPositions[1].z=b[2];m.stdDev=s;OutlierFilterTdoaState_t o;kalmanCoreUpdateWithTdoa(&d,&m,ms,&o);}
static float ideal(const float x,const float y,const float z,const float t,const lighthouseCalibrationSweep_t*c){float r=sqrtf(x*x+y*y);return atan2f(y,x)+asinf(z*tanf(t)/r);}
void k_sweep(float angle,float t,float*sensor,float*rotor,float*R,float s,unsigned ms){static vec3d sp,rp;static mat3d M,I;for(int i=0;i<3;i++){sp[i]=sensor[i];rp[i]=rotor[i];for(int j=0;j<3;j++){M[i][j]=R[3*i+j];I[j][i]=R[3*i+j];}}sweepAngleMeasurement_t m={0};m.sensorPos=&sp;m.rotorPos=&rp;m.rotorRot=&M;m.rotorRotInv=&I;m.t=t;m.measuredSweepAngle=angle;m.stdDev=s;m.calibrationMeasurementModel=(void*)ideal;OutlierFilterLhState_t o;kalmanCoreUpdateWithSweepAngles(&d,&m,ms,&o);}
int k_finalize(void){return kalmanCoreFinalize(&d);}
void k_get(float*S,float*q,float*P){memcpy(S,d.S,36);memcpy(q,d.q,16);memcpy(P,d.P,324);}
void assertFail(char*a,char*b,int c){}
